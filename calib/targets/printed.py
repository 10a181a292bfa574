"""A board as a PDF to print: vector shapes in millimetres, a bar to check with a ruler, and what to tell calib.

One page, no compression: a person can read what is in it.
"""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.calib.record.pdf import MM, Page, circle, file
from ceilvo.calib.targets.board import Board
from ceilvo.errors import CalibrationError

PAPERS_MM = {"A4": (210.0, 297.0), "A3": (297.0, 420.0), "Letter": (215.9, 279.4)}
"""Narrow and long side."""
MARGIN_MM = 10.0
"""White round everything: most printers leave 4 to 6 mm, and finders need white around a board."""
BAR_MM, _TICK_MM = 100.0, 10.0
"""Of the bar to check with a ruler."""
_FOOT_MM, _TEXT_MM, _LINE_MM = 20.0, 3.0, 0.2
"""Room under the board for bar and text; height of the text and width of the lines."""


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
        drawn.append(circle(*at(d.x, d.y), 1e3 * d.radius))
    content = [f"{MM:.9f} 0 0 {MM:.9f} 0 0 cm", "0 g", *drawn, "f", *_foot(s)]
    return file([Page(s.width_mm * MM, s.height_mm * MM, content)], packed=False)


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
