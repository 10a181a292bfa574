"""A record as blocks, told twice: as one HTML file in which nothing is loaded from elsewhere, and as a PDF on A4."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

from ceilvo.calib.record import pdf
from ceilvo.calib.record.pdf import A4, MM, Page

Verdict: TypeAlias = Literal["good", "bad", "none"]
PHOTO_PX = 1400
"""Longer side of a picture in the record; chosen: sharp on half a page, and some hundred kB."""
_COLOURS: dict[str, str] = {"good": "#1b6e3c", "bad": "#b3261e", "none": "#666666"}
_STYLE = (
    ":root{color-scheme:light dark}"
    "body{font:15px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem}"
    "h1{margin-bottom:.2rem}h2{margin-top:2.2rem;border-top:1px solid #999;padding-top:.8rem}"
    "table{border-collapse:collapse;margin:.6rem 0;width:100%}"
    "td,th{border-bottom:1px solid #bbb;padding:.25rem .7rem .25rem 0;text-align:left;vertical-align:top}"
    "td.note{color:#777;font-size:.9em}.verdict{color:#fff;padding:.1rem .6rem;border-radius:.2rem;font-weight:600}"
    "figure{margin:1rem 0;break-inside:avoid}figcaption{color:#777;font-size:.9em}"
    "svg,img{max-width:100%;height:auto;background:#fff}"
    "@media print{body{margin:0;max-width:none;font-size:11px}h2,tr{break-after:avoid;break-inside:avoid}}"
)
_LEFT, _TOP, _BOTTOM = 18.0 * MM, 18.0 * MM, 18.0 * MM
_ROOM = A4[0] - 2.0 * _LEFT
_SIZE, _SMALL, _LINE = 9.0, 7.5, 1.35
"""Points of words and of notes, and line height in their sizes."""
_COLUMNS = (0.20, 0.42, 0.38)
"""Shares of a table's width: name, figure, what it means."""
_FIGURE_MM = 106.0
"""Greatest height of a drawing or a picture on paper: two and some words on a sheet."""


@dataclass(frozen=True)
class Heading:
    """A part of the record, with its verdict where it has one."""

    words: str
    verdict: str = ""
    look: Verdict = "none"


@dataclass(frozen=True)
class Text:
    words: str
    look: Verdict | None = None


@dataclass(frozen=True)
class Table:
    """Rows of name, figure with its unit, and what it means ("" where the name says it)."""

    rows: Sequence[tuple[str, str, str]]


@dataclass(frozen=True)
class Figure:
    """A drawing (SVG of drawing.py) or a picture (PNG or JPEG), with words below."""

    shown: str | bytes
    caption: str


Block: TypeAlias = "Heading | Text | Table | Figure"


@dataclass(frozen=True)
class Document:
    """The title, a line below it, and all that follows."""

    title: str
    subtitle: str
    blocks: Sequence[Block]


# -- for browsers


def html_of(document: Document) -> str:
    body = "\n".join(_html(block) for block in document.blocks)
    return (
        "<!doctype html>\n<html lang='en'><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width,initial-scale=1'>"
        f"<title>{_e(document.title)}</title><style>{_STYLE}</style>\n"
        f"<h1>{_e(document.title)}</h1><p>{_e(document.subtitle)}</p>\n{body}\n</html>\n"
    )


def _e(words: str) -> str:
    return html.escape(words)


def _html(block: Block) -> str:
    if isinstance(block, Heading):
        return f"<h2>{_e(block.words)} {_badge(block)}</h2>"
    if isinstance(block, Text):
        colour = f" style='color:{_COLOURS[block.look]};font-weight:600'" if block.look else ""
        return f"<p{colour}>{_e(block.words)}</p>"
    if isinstance(block, Table):
        notes = any(note for _, _, note in block.rows)
        cells = (
            f"<th>{_e(n)}</th><td>{_e(v)}</td>" + (f"<td class='note'>{_e(w)}</td>" if notes else "")
            for n, v, w in block.rows
        )
        return "<table>" + "".join(f"<tr>{c}</tr>" for c in cells) + "</table>"
    if isinstance(block.shown, str):
        shown = block.shown
    else:
        found = pdf.jpeg_of(block.shown, PHOTO_PX)
        data = b"" if found is None else found[0]
        shown = f"<img alt='{_e(block.caption)}' src='data:image/jpeg;base64,{base64.b64encode(data).decode()}'>"
    return f"<figure>{shown}<figcaption>{_e(block.caption)}</figcaption></figure>"


def _badge(block: Heading) -> str:
    look = _COLOURS[block.look]
    return f"<span class='verdict' style='background:{look}'>{_e(block.verdict)}</span>" if block.verdict else ""


# -- for paper


@dataclass
class _Sheets:
    """Sheets that fill from above; y is where the next line goes."""

    pages: list[Page] = field(default_factory=list)
    y: float = 0.0

    def need(self, height: float) -> Page:
        """The sheet that has so much room, a new one if need be."""
        if not self.pages or self.y - height < _BOTTOM:
            self.pages.append(Page(*A4))
            self.y = A4[1] - _TOP
        return self.pages[-1]

    def words(self, words: str, size: float, *, bold: bool = False, colour: str = "#000000") -> None:
        for line in pdf.wrapped(words, size, _ROOM, bold):
            page = self.need(size * _LINE)
            self.y -= size * _LINE
            page.text(_LEFT, self.y, line, size, bold=bold, colour=colour)


def pdf_of(document: Document) -> bytes:
    sheets = _Sheets()
    sheets.words(document.title, 18.0, bold=True)
    sheets.words(document.subtitle, _SIZE)
    sheets.y -= 6.0
    for block in document.blocks:
        _place(sheets, block)
    for i, page in enumerate(sheets.pages, 1):
        foot = f"{document.title}, sheet {i} of {len(sheets.pages)}"
        page.text(_LEFT, 0.5 * _BOTTOM, foot, _SMALL, colour="#666666")
    return pdf.file(sheets.pages)


def _place(sheets: _Sheets, block: Block) -> None:
    if isinstance(block, Heading):
        page = sheets.need(30.0 * MM)  # not alone at the foot
        sheets.y -= 24.0
        page.text(_LEFT, sheets.y, block.words, 13.0, bold=True)
        if block.verdict:
            x, wide = (
                _LEFT + pdf.width_of(block.words, 13.0, True) + 10.0,
                pdf.width_of(block.verdict, _SIZE, True) + 8.0,
            )
            page.rect(x, sheets.y - 3.0, wide, 13.0, _COLOURS[block.look])
            page.text(x + 4.0, sheets.y, block.verdict, _SIZE, bold=True, colour="#ffffff")
        sheets.y -= 6.0
    elif isinstance(block, Text):
        sheets.words(
            block.words, _SIZE, bold=block.look is not None, colour=_COLOURS[block.look] if block.look else "#000000"
        )
        sheets.y -= 4.0
    elif isinstance(block, Table):
        for row in block.rows:
            _row(sheets, row)
        sheets.y -= 6.0
    else:
        _figure(sheets, block)


def _row(sheets: _Sheets, row: tuple[str, str, str]) -> None:
    shares = _COLUMNS if row[2] else (_COLUMNS[0], 1.0 - _COLUMNS[0], 0.0)
    sizes = (_SIZE, _SIZE, _SMALL)
    cells = [
        pdf.wrapped(words, size, share * _ROOM - 6.0, k == 0) if words else []
        for k, (words, size, share) in enumerate(zip(row, sizes, shares, strict=True))
    ]
    height = max(len(c) for c in cells) * _SIZE * _LINE + 3.0
    page, x = sheets.need(height), _LEFT
    for k, (lines, size, share) in enumerate(zip(cells, sizes, shares, strict=True)):
        for i, line in enumerate(lines):
            colour = "#000000" if k < 2 else "#666666"
            page.text(x, sheets.y - (i + 1) * _SIZE * _LINE, line, size, bold=k == 0, colour=colour)
        x += share * _ROOM
    sheets.y -= height
    page.rect(_LEFT, sheets.y - 0.5, _ROOM, 0.3, "#bbbbbb")


def _figure(sheets: _Sheets, block: Figure) -> None:
    found = None if isinstance(block.shown, str) else pdf.jpeg_of(block.shown, PHOTO_PX)
    w, h = _size(block.shown) if isinstance(block.shown, str) else (1.0, 0.0) if found is None else found[1]
    scale = min(_ROOM / w, _FIGURE_MM * MM / max(h, 1.0))
    page = sheets.need(h * scale + 2.0 * _SMALL * _LINE)
    if isinstance(block.shown, str):
        page.svg(block.shown, _LEFT, sheets.y, scale)
    elif found is not None:
        page.picture(found[0], found[1], _LEFT, sheets.y - h * scale, w * scale, h * scale)
    sheets.y -= h * scale
    sheets.words(block.caption, _SMALL, colour="#666666")
    sheets.y -= 8.0


def _size(svg: str) -> tuple[float, float]:
    head = dict(part.split("=", 1) for part in svg[: svg.index(">")].split() if "=" in part)
    return float(head["width"].strip('"')), float(head["height"].strip('"'))
