"""The report as a customer gets it: who, where, photographs; read back from the page and from the sheets."""

from __future__ import annotations

import html
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pypdfium2

from ceilvo.calib.session.session import Session

Run = Callable[..., tuple[int, str, str]]


def test_a_report_names_site_robot_and_operator_and_shows_photographs(
    run: Run, known_lens: Session, tmp_path: Path
) -> None:
    photo = tmp_path / "camera on its mast.jpg"
    photo.write_bytes(bytes(cv2.imencode(".jpg", np.full((90, 120, 3), 200, np.uint8))[1].tobytes()))
    run("report", "--site", "Hall <3>", "--robot", "AGV-12", "--operator", "M. Chen", "--photo", str(photo))
    run("report", "--force", "--operator", "A. Weber")  # the rest is as it was said before
    page, sheets = (known_lens.folder / "report.html").read_text(), (known_lens.folder / "report.pdf").read_bytes()
    with pypdfium2.PdfDocument(sheets) as file:
        first = file[0].get_textpage().get_text_bounded()
    for words in ("Commissioning of AGV-12", "Hall <3>", "A. Weber"):
        assert html.escape(words) in page and words in first
    assert "M. Chen" not in page
    run("report", "--force", "--photo", str(photo))
    assert "camera on its mast" in (known_lens.folder / "report.html").read_text()
    for bad in (tmp_path / "none.jpg", known_lens.folder / "intrinsics.json"):
        code, _, err = run("report", "--force", "--photo", str(bad))
        assert code == 78 and f"--photo {bad}" in err and len(err.splitlines()) == 1
