"""A board as a PDF to print: vector shapes in millimetres, a bar to check with a ruler, and what to tell calib.

One page, no compression, one of the standard fonts: nothing that a library is needed for (ISO 32000-1).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ceilvo.calib.targets.board import Board
from ceilvo.errors import CalibrationError

PAPERS_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "Letter": (215.9, 279.4)}
"""Narrow and long side."""
_POINTS = 72.0 / 25.4
"""PDF units a millimetre."""
MARGIN_MM = 10.0
"""White round everything: most printers leave 4 to 6 mm, and finders need white around a board."""
BAR_MM, _TICK_MM = 100.0, 10.0
"""Of the bar to check with a ruler."""
_FOOT_MM, _TEXT_MM, _LINE_MM = 20.0, 3.0, 0.2
"""Room under the board for bar and text; height of the text and width of the lines."""
_ROUND = 0.5523
"""Of the radius: control points of four Bezier curves that make a circle, to 0.03 % of it."""


@dataclass(frozen=True)
class Sheet:
    """A board on paper: size of the page as it is turned, and where the board's upper left black corner is, mm."""

    board: Board
    width_mm: float
    height_mm: float
    left_mm: float
    top_mm: float


def room_mm(paper: str, landscape: bool) -> tuple[float, float]:
    """Width and height that the board may have."""
    narrow, long = PAPERS_MM[paper]
    w, h = (long, narrow) if landscape else (narrow, long)
    return w - 2.0 * MARGIN_MM, h - 2.0 * MARGIN_MM - _FOOT_MM


def sheet(board: Board, paper: str) -> Sheet:
    """The board in the middle of the page, which is turned as it fits.

    Raises:
        CalibrationError: the board is larger than the paper.
    """
    x0, y0, x1, y1 = (1e3 * v for v in board.extent_m)
    w, h = x1 - x0, y1 - y0
    landscape = w > h
    room = room_mm(paper, landscape)
    if w > room[0] or h > room[1]:
        fits = 1e3 * board.square_m * min(room[0] / w, room[1] / h)
        raise CalibrationError(
            f"--square-mm: found {1e3 * board.square_m:g}, a board of {w:.0f} x {h:.0f} mm, expected at most "
            f"{fits:.1f} on {paper}, or fewer columns and rows, or larger paper"
        )
    narrow, long = PAPERS_MM[paper]
    page = (long, narrow) if landscape else (narrow, long)
    return Sheet(board, *page, 0.5 * (page[0] - w), MARGIN_MM + 0.5 * (room[1] - h))


def pdf(s: Sheet) -> bytes:
    """The file."""
    x0, y0 = (1e3 * v for v in s.board.extent_m[:2])

    def at(x_m: float, y_m: float) -> tuple[float, float]:
        """Page millimetres, y up, of a place on the board."""
        return s.left_mm + 1e3 * x_m - x0, s.height_mm - (s.top_mm + 1e3 * y_m - y0)

    rects, discs = s.board.shapes
    drawn = []
    for r in rects:  # all in one path, so that no hairline shows where two touch
        x, y = at(r.x, r.y + r.height)
        drawn.append(f"{x:.5f} {y:.5f} {1e3 * r.width:.5f} {1e3 * r.height:.5f} re")
    for d in discs:
        drawn.append(_circle(*at(d.x, d.y), 1e3 * d.radius))
    content = "\n".join([f"{_POINTS:.9f} 0 0 {_POINTS:.9f} 0 0 cm", "0 g", *drawn, "f", *_foot(s)])
    return _file(s, content)


def _circle(x: float, y: float, r: float) -> str:
    k = _ROUND * r
    curves = (
        (x + r, y + k, x + k, y + r, x, y + r),
        (x - k, y + r, x - r, y + k, x - r, y),
        (x - r, y - k, x - k, y - r, x, y - r),
        (x + k, y - r, x + r, y - k, x + r, y),
    )
    parts = [f"{' '.join(f'{v:.5f}' for v in c)} c" for c in curves]
    return f"{x + r:.5f} {y:.5f} m " + " ".join(parts) + " h"


def _foot(s: Sheet) -> list[str]:
    """The bar with its ticks, and two lines of text."""
    left, bottom = MARGIN_MM, MARGIN_MM
    ticks = [left + i * _TICK_MM for i in range(round(BAR_MM / _TICK_MM) + 1)]
    lines = [f"{left:.5f} {bottom + 9:.5f} m {left + BAR_MM:.5f} {bottom + 9:.5f} l"]
    lines += [f"{x:.5f} {bottom + 9:.5f} m {x:.5f} {bottom + 12:.5f} l" for x in ticks]
    told = (
        (left, bottom + 5, f"The bar is {BAR_MM:g} mm from tick to tick: check it with a ruler. Print at 100 %."),
        (left, bottom + 1, f"calib intrinsics {s.board.options}"),
    )  # fmt: skip
    texts = [f"BT /F {_TEXT_MM:g} Tf {x:.5f} {y:.5f} Td ({text}) Tj ET" for x, y, text in told]
    return [f"{_LINE_MM:g} w", *lines, "S", *texts]


def _file(s: Sheet, content: str) -> bytes:
    box = f"0 0 {s.width_mm * _POINTS:.4f} {s.height_mm * _POINTS:.4f}"
    stream = content.encode("ascii")
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Contents 4 0 R "
        "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]  # fmt: skip
    return _numbered(objects)


def _numbered(objects: Sequence[bytes]) -> bytes:
    """Objects from 1 on with the table of where each begins."""
    out, begins = b"%PDF-1.7\n", []
    for i, body in enumerate(objects, 1):
        begins.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (i, body)
    table = b"".join(b"%010d 00000 n \n" % b for b in begins)
    count = len(objects) + 1
    end = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (count, len(out))
    return out + b"xref\n0 %d\n0000000000 65535 f \n" % count + table + end
