"""Calibration boards: what is printed on them and where their corners are."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]
Kind = Literal["chessboard", "charuco", "aprilgrid", "circles", "acircles"]

KINDS: tuple[Kind, ...] = ("chessboard", "charuco", "aprilgrid", "circles", "acircles")
_SIDES = (3, 40)
"""Corners along a side, least and most; chosen, larger ones are typing mistakes."""
MARKER = {"chessboard": 0.72, "charuco": 0.72, "aprilgrid": 1.0 / 1.3, "circles": 0.5, "acircles": 0.8}
"""Of the square: a ChArUco marker, a tag (Kalibr's gap of 0.3 tags), and the circles' diameter; chosen."""
DICTIONARY, TAGS = "5X5_100", "APRILTAG_36h11"
"""Usual dictionaries of ChArUco boards and of AprilGrids."""
TAG_BORDERS = (2, 1)
"""Cells of a tag's black border: Kalibr prints two, OpenCV one."""


@dataclass(frozen=True)
class Rect:
    """A black rectangle: its corner with the smallest coordinates, and its size, m."""

    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True)
class Disc:
    """A black disc: middle and radius, m."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True)
class Board:
    """A flat board; its axes are x to the right and y down as one looks at it.

    Attributes:
        kind: chessboard; charuco (a chessboard with markers, which may be seen in part); aprilgrid (as Kalibr prints
            it: tags in rows from the bottom left, small squares where four of them meet; may be seen in part);
            circles and acircles, circle grids in rows above one another and in rows shifted by half.
        columns, rows: inner corners of a chessboard; squares of a ChArUco board; tags; circles.
        square_m: side of a square; from tag to tag; from circle to circle; of acircles from row to row.
        marker_m: side of a marker or a tag, diameter of a circle.
        dictionary: of the markers, cv2.aruco's name without DICT_.
        legacy: ChArUco as OpenCV drew it before 4.6: a marker, not a black square, in the corner where rows are even.
    """

    kind: Kind = "chessboard"
    columns: int = 9
    rows: int = 6
    square_m: float = 0.025
    marker_m: float = 0.018
    dictionary: str = DICTIONARY
    legacy: bool = False

    def __post_init__(self) -> None:
        low, high = (2 if self.kind == "aprilgrid" else _SIDES[0]), _SIDES[1]
        if not (low <= self.columns <= high and low <= self.rows <= high):
            raise CalibrationError(f"board: found {self.columns} x {self.rows}, expected {low} to {high} each way")
        if not 0.001 <= self.square_m <= 1.0:
            raise CalibrationError(
                f"board: found squares of {self.square_m:g} m, expected 0.001 to 1; is it in millimetres?"
            )
        if self.kind != "chessboard" and not 0.2 * self.square_m < self.marker_m < self.square_m:
            raise CalibrationError(
                f"board: found markers of {self.marker_m:g} m, expected less than the square's {self.square_m:g} m"
            )
        if self.marked and not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            raise CalibrationError(f"board: found dictionary {self.dictionary!r}, expected for example 5X5_100")
        if self.marked and self._markers > len(self.words.bytesList):
            raise CalibrationError(
                f"board: found {self._markers} markers, expected at most the {len(self.words.bytesList)} of "
                f"{self.dictionary}; fewer columns and rows, or a larger dictionary"
            )

    @property
    def marked(self) -> bool:
        """Whether it has markers, so that a part of it is enough."""
        return self.kind in ("charuco", "aprilgrid")

    @property
    def _markers(self) -> int:
        cells = self.columns * self.rows
        return cells if self.kind == "aprilgrid" else (cells + 1) // 2

    @property
    def text(self) -> str:
        cells = {"chessboard": "corners", "charuco": "squares", "aprilgrid": "tags"}.get(self.kind, "circles")
        old = ", legacy" if self.legacy else ""
        return f"{self.kind} of {self.columns} x {self.rows} {cells}, {1e3 * self.square_m:g} mm{old}"

    @property
    def options(self) -> str:
        """For the command line of calib intrinsics."""
        out = f"--board {self.kind} --columns {self.columns} --rows {self.rows} --square-mm {1e3 * self.square_m:g}"
        if self.marked:
            out += f" --marker-mm {1e3 * self.marker_m:g} --dictionary {self.dictionary}"
        return out + (" --legacy" if self.legacy else "")

    @property
    def subject(self) -> dict[str, Any]:
        """What samples of it are samples of."""
        what = asdict(self)
        if not self.legacy:
            del what["legacy"]  # as before there was such a thing
        return {"board": what}

    @cached_property
    def corners_m(self) -> Array:
        """(N, 3) inner corners, or middles of circles, row by row; of an AprilGrid each tag's four, clockwise."""
        s = self.square_m
        if self.kind == "aprilgrid":
            xy = np.concatenate([self._tag_at(i) + self._tag_corners for i in range(self._markers)])
        else:
            c, r = (self.columns - 1, self.rows - 1) if self.kind == "charuco" else (self.columns, self.rows)
            xy = np.mgrid[:c, :r].T.reshape(-1, 2) * s
            if self.kind == "charuco":
                xy = xy + s
            if self.kind == "acircles":
                row = np.repeat(np.arange(r), c)
                xy = xy * [2.0, 1.0] + np.column_stack([(row % 2) * s, np.zeros(len(row))])
        return np.column_stack([xy, np.zeros(len(xy))])

    @property
    def _tag_corners(self) -> Array:
        return self.marker_m * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])

    def _tag_at(self, tag: int) -> Array:
        """Upper left corner of a tag; the first is at the bottom left."""
        row, column = divmod(tag, self.columns)
        return self.square_m * np.array([column, self.rows - 1 - row], np.float64)

    @cached_property
    def words(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))

    @cached_property
    def charuco(self) -> cv2.aruco.CharucoBoard:
        board = cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, self.words)
        board.setLegacyPattern(self.legacy)
        return board

    @cached_property
    def shapes(self) -> tuple[list[Rect], list[Disc]]:
        """All that is black on it, in its axes."""
        s = self.square_m
        if self.kind in ("circles", "acircles"):
            return [], [Disc(float(x), float(y), 0.5 * self.marker_m) for x, y, _ in self.corners_m]
        if self.kind == "chessboard":
            cells = [(i, j) for j in range(self.rows + 1) for i in range(self.columns + 1) if (i + j) % 2 == 0]
            return [Rect((i - 1) * s, (j - 1) * s, s, s) for i, j in cells], []
        if self.kind == "aprilgrid":
            gap = s - self.marker_m
            squares = [
                Rect(i * s - gap, j * s - gap, gap, gap) for j in range(self.rows + 1) for i in range(self.columns + 1)
            ]
            tags = [r for i in range(self._markers) for r in self._cells(i, self._tag_at(i), TAG_BORDERS[0])]
            return squares + tags, []
        corners = [np.asarray(c, np.float64)[0, :2] for c in self.charuco.getObjPoints()]
        taken = {(int(x // s), int(y // s)) for x, y in corners}
        squares = [
            Rect(i * s, j * s, s, s) for j in range(self.rows) for i in range(self.columns) if (i, j) not in taken
        ]
        ids = np.ravel(self.charuco.getIds())
        return squares + [r for i, at in zip(ids, corners, strict=True) for r in self._cells(int(i), at, 1)], []

    def _cells(self, number: int, at: Array, border: int) -> list[Rect]:
        """The black cells of a marker, those of a row that touch as one."""
        n = self.words.markerSize + 2 * border
        side = self.marker_m / n
        black = self.words.generateImageMarker(number, n, borderBits=border) == 0
        out = []
        for j, row in enumerate(black):
            edges = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(np.int8), [0]])))
            for a, b in zip(edges[::2], edges[1::2], strict=True):
                out.append(Rect(float(at[0] + a * side), float(at[1] + j * side), float((b - a) * side), side))
        return out

    @cached_property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Least x and y, largest x and y of all that is black."""
        rects, discs = self.shapes
        boxes = [(r.x, r.y, r.x + r.width, r.y + r.height) for r in rects]
        boxes += [(d.x - d.radius, d.y - d.radius, d.x + d.radius, d.y + d.radius) for d in discs]
        a = np.array(boxes)
        return float(a[:, 0].min()), float(a[:, 1].min()), float(a[:, 2].max()), float(a[:, 3].max())
