"""The record on paper: read back and drawn by another program (PDFium)."""

from __future__ import annotations

import cv2
import numpy as np
import pypdfium2
import pytest

from ceilvo.calib.record import pdf
from ceilvo.calib.record.document import Document, Figure, Heading, Table, Text, html_of, pdf_of
from ceilvo.calib.record.drawing import Drawing


def photo(width: int = 300, height: int = 200) -> bytes:
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2] = (0, 0, 255)
    return bytes(cv2.imencode(".png", image)[1].tobytes())


def drawing() -> str:
    d = Drawing(200.0, 100.0)
    d.rect(0, 0, 100, 100, "#0000ff")
    d.dots((150.0, 50.0), "#00ff00", 20)
    d.text(150, 90, "low & (right)", anchor="middle")
    return d.svg()


def document(rows: int = 3) -> Document:
    table = Table([(f"name {k}", f"{k}.5 px, \u00b1 1 \u00b5m", "what <it> means, in some words") for k in range(rows)])
    blocks = [Heading("A part", "PASS", "good"), Text("as \\ it (is)", "bad"), table, Figure(photo(), "a photograph")]
    return Document("Title & more", "below", [*blocks, Figure(drawing(), "a drawing")])


def read(data: bytes) -> list[str]:
    with pypdfium2.PdfDocument(data) as file:
        return [page.get_textpage().get_text_bounded() for page in file]


def test_all_words_are_on_paper_and_in_the_page() -> None:
    text, page = "\n".join(read(pdf_of(document()))), html_of(document())
    for words in ("Title & more", "A part", "PASS", "as \\ it (is)", "name 2", "\u00b1 1 \u00b5m", "a drawing"):
        assert words in text
        assert words.replace("&", "&amp;") in page
    assert "what <it> means" in text and "what &lt;it&gt; means" in page
    assert "low & (right)" in text and "sheet 1 of 1" in text


def test_a_long_table_goes_on_on_the_next_sheet_and_nothing_is_cut() -> None:
    sheets = read(pdf_of(document(150)))
    assert len(sheets) > 2
    assert [sum(f"name {k}\r" in s or f"name {k}\n" in s or f"name {k} " in s for s in sheets) for k in range(150)] == [
        1
    ] * 150
    with pypdfium2.PdfDocument(pdf_of(document(150))) as file:
        for page in file:
            text = page.get_textpage()
            boxes = [text.get_charbox(k) for k in range(text.count_chars())]
            assert (
                min(b[0] for b in boxes) > 40 and max(b[2] for b in boxes) < 595 - 40 and min(b[1] for b in boxes) > 20
            )


def test_pictures_and_drawings_look_as_they_do_elsewhere() -> None:
    with pypdfium2.PdfDocument(pdf_of(Document("t", "", [Figure(photo(), "p"), Figure(drawing(), "d")]))) as file:
        image = file[0].render(scale=1.0).to_numpy()[:, :, ::-1].astype(int)  # RGB
    red = (abs(image - (255, 0, 0)) < 40).all(axis=2)
    black = (image < 40).all(axis=2)
    blue, green = ((abs(image - c) < 5).all(axis=2) for c in ((0, 0, 255), (0, 255, 0)))
    assert red.sum() == pytest.approx(black.sum(), rel=0.05)
    y, x = (np.mean(np.nonzero(red)[k]) for k in (0, 1))
    assert x < np.mean(np.nonzero(black)[1]) and y < np.mean(np.nonzero(blue)[0])
    side = np.sqrt(blue.sum())
    assert green.sum() / side**2 == pytest.approx(np.pi * 0.2**2, rel=0.05)  # a disc of 20 beside a square of 100
    assert np.mean(np.nonzero(green)[1]) > np.nonzero(blue)[1].max()


def test_lines_are_no_longer_than_their_room() -> None:
    """By PDFium's widths, not by ours."""
    words = "Leaning views, WIDE WORDS (MMMM), near and far: 0.123 +- 0.004 px make it sure"
    page = pdf.Page(*pdf.A4)
    lines = pdf.wrapped(words, 9.0, 120.0)
    for k, line in enumerate(lines):
        page.text(50.0, 700.0 - 20 * k, line, 9.0)
    assert " ".join(lines) == words and len(lines) > 2
    with pypdfium2.PdfDocument(pdf.file([page])) as file:
        text = file[0].get_textpage()
        right = max(text.get_charbox(k)[2] for k in range(text.count_chars()))
    assert 120.0 < right <= 50.0 + 121.0
    assert (
        pdf.wrapped("x" * 99, 9.0, 100.0)
        and max(pdf.width_of(w, 9.0) for w in pdf.wrapped("x" * 99, 9.0, 100.0)) <= 100.0
    )


def test_a_photograph_is_made_smaller_and_loses_where_it_was_taken() -> None:
    large = cv2.imencode(".jpg", np.zeros((1000, 3000, 3), np.uint8))[1].tobytes()
    tagged = large[:2] + b"\xff\xe1\x00\x12Exif\x00\x00GPS 48.4 N" + large[2:]
    found = pdf.jpeg_of(tagged, 1400)
    assert found is not None and found[1] == (1400, 467) and b"GPS" not in found[0]
    assert pdf.jpeg_of(b"no picture", 100) is None and pdf.jpeg_of(b"", 100) is None
