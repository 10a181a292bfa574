"""Calibration boards: what they look like, where their corners are in a picture, and why a picture is no use."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

_SATURATED, _SATURATED_FRACTION = 253, 0.25
_DARK = 18.0
_SOFT_EDGE_PX = 5.0
_CHARUCO_CORNERS = 8
_BORDER_PX = 2.0


@dataclass(frozen=True)
class Board:
    """A flat board.

    Attributes:
        kind: chessboard, or charuco (a chessboard with markers, which may be seen in part).
        columns, rows: inner corners of a chessboard; squares of a ChArUco board.
        square_m: side of a square.
        marker_m: side of a ChArUco marker.
        dictionary: of its markers, cv2.aruco's name without DICT_.
    """

    kind: Literal["chessboard", "charuco"] = "chessboard"
    columns: int = 9
    rows: int = 6
    square_m: float = 0.025
    marker_m: float = 0.018
    dictionary: str = "5X5_100"

    def __post_init__(self) -> None:
        low = 3
        if not (low <= self.columns <= 40 and low <= self.rows <= 40):
            raise CalibrationError(f"board: found {self.columns} x {self.rows}, expected {low} to 40 each way")
        if not 0.001 <= self.square_m <= 1.0:
            raise CalibrationError(
                f"board: found squares of {self.square_m:g} m, expected 0.001 to 1; is it in millimetres?"
            )
        if self.kind == "charuco" and not 0.2 * self.square_m < self.marker_m < self.square_m:
            raise CalibrationError(
                f"board: found markers of {self.marker_m:g} m, expected less than the square's {self.square_m:g} m"
            )
        if self.kind == "charuco" and not hasattr(cv2.aruco, f"DICT_{self.dictionary}"):
            raise CalibrationError(f"board: found dictionary {self.dictionary!r}, expected for example 5X5_100")

    @property
    def text(self) -> str:
        squares = "corners" if self.kind == "chessboard" else "squares"
        return f"{self.kind} of {self.columns} x {self.rows} {squares}, {1e3 * self.square_m:g} mm"

    @property
    def subject(self) -> dict[str, Any]:
        """What samples of it are samples of."""
        return {"board": asdict(self)}

    @cached_property
    def corners_m(self) -> Array:
        """(N, 3) inner corners on the board, row by row."""
        c, r = (self.columns, self.rows) if self.kind == "chessboard" else (self.columns - 1, self.rows - 1)
        grid = np.mgrid[:c, :r].T.reshape(-1, 2) * self.square_m
        first = 0.0 if self.kind == "chessboard" else self.square_m
        return np.column_stack([grid + first, np.zeros(len(grid))])

    @cached_property
    def charuco(self) -> cv2.aruco.CharucoBoard:
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary}"))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, words)


@dataclass(frozen=True)
class Sighting:
    """Corners in a picture: ids (N,) into Board.corners_m and uv_px (N, 2), or none with the reason."""

    ids: NDArray[np.int64]
    uv_px: Array
    reason: str = ""

    @property
    def ok(self) -> bool:
        return not self.reason


def _nothing(reason: str) -> Sighting:
    return Sighting(np.zeros(0, np.int64), np.zeros((0, 2)), reason)


class BoardFinder:
    """Finds one board in pictures.

    Args:
        window_px: half side of the window that a corner is refined in; None takes what the squares' size allows, at
            most 11. A window that reaches the next corner biases both.
    """

    def __init__(self, board: Board, window_px: int | None = None) -> None:
        self.board = board
        self._window = window_px
        self._detector = cv2.aruco.CharucoDetector(board.charuco) if board.kind == "charuco" else None

    def __call__(self, gray: Gray) -> Sighting:
        reason = light_problem(gray)
        if reason:
            return _nothing(reason)
        ids, uv = self._chessboard(gray) if self._detector is None else self._charuco(gray)
        if len(ids) == 0:
            width = edge_width_px(gray)
            if width > _SOFT_EDGE_PX:
                return _nothing(f"blurred: edges are {width:.1f} px wide; hold still, focus, more light")
            return _nothing("board not seen as a whole" if self._detector is None else "board not seen")
        if len(ids) < _CHARUCO_CORNERS:
            return _nothing(f"only {len(ids)} corners seen, {_CHARUCO_CORNERS} needed")
        h, w = gray.shape
        low, high = uv.min(axis=0), uv.max(axis=0)
        if (low < _BORDER_PX).any() or (high > np.array([w, h]) - 1 - _BORDER_PX).any():
            return _nothing("a corner lies on the picture's edge")
        x0, y0 = np.maximum(low.astype(int) - 5, 0)
        width = edge_width_px(gray[y0 : int(high[1]) + 6, x0 : int(high[0]) + 6])
        if width > _SOFT_EDGE_PX:
            return _nothing(f"blurred: the board's edges are {width:.1f} px wide; hold still, focus, more light")
        return Sighting(ids, self._refine(gray, ids, uv))

    def _chessboard(self, gray: Gray) -> tuple[NDArray[np.int64], Array]:
        size = (self.board.columns, self.board.rows)
        if not cv2.checkChessboard(gray, size):  # quick; without it a picture without a board takes seconds
            return np.zeros(0, np.int64), np.zeros((0, 2))
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(gray, size, flags=flags)
        if not found:
            found, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        if not found:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        uv = np.asarray(corners, np.float64).reshape(-1, 2)
        return np.arange(len(uv)), uv

    def _charuco(self, gray: Gray) -> tuple[NDArray[np.int64], Array]:
        if self._detector is None:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        corners, ids, _, _ = self._detector.detectBoard(gray)
        if np.size(ids) == 0 or np.ndim(corners) == 0:  # None in some versions
            return np.zeros(0, np.int64), np.zeros((0, 2))
        return np.asarray(ids, np.int64).reshape(-1), np.asarray(corners, np.float64).reshape(-1, 2)

    def _refine(self, gray: Gray, ids: NDArray[np.int64], uv: Array) -> Array:
        room = 0.35  # of a square, to the next thing with edges
        if self.board.kind == "charuco":
            room = 0.4 * (self.board.square_m - self.board.marker_m) / self.board.square_m
        window = self._window or int(np.clip(room * self._spacing_px(ids, uv), 2, 11))
        until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
        corners = uv.astype(np.float32).reshape(-1, 1, 2)
        return np.asarray(cv2.cornerSubPix(gray, corners, (window, window), (-1, -1), until), np.float64).reshape(-1, 2)

    def _spacing_px(self, ids: NDArray[np.int64], uv: Array) -> float:
        """Distance to the nearest other corner, the smallest in the picture."""
        d = np.hypot(*(uv[:, None] - uv[None]).transpose(2, 0, 1))
        d[np.diag_indices(len(d))] = np.inf
        return float(d.min())


def light_problem(gray: Gray) -> str:
    """Why a picture's light makes it useless, "" when it does not."""
    saturated = float(np.mean(gray >= _SATURATED))
    if saturated > _SATURATED_FRACTION:
        return f"saturated: {100 * saturated:.0f} % of the picture is white; shorten the exposure"
    level = float(np.percentile(gray, 99))
    if level < _DARK:
        return f"too dark: the brightest part has grey level {level:.0f}; lengthen the exposure"
    return ""


def edge_width_px(gray: Gray) -> float:
    """Width of the sharpest edges: contrast over the steepest gradient, about 1.5 when in focus."""
    soft = cv2.GaussianBlur(gray, (3, 3), 0)
    dx = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=0.125))
    dy = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=0.125))
    steepest = float(np.percentile(np.hypot(dx, dy), 99.8))
    contrast = float(np.percentile(soft, 98)) - float(np.percentile(soft, 2))
    return contrast / steepest if steepest > 0.5 else np.inf


def other_board(gray: Gray) -> str:
    """The size of a chessboard that is in the picture, as "7 x 5", "" when there is none."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    sizes = ((c, r) for c in range(12, 2, -1) for r in range(c, 2, -1))
    for c, r in sizes:  # the largest first: a part of a board is a board as well
        if cv2.findChessboardCorners(gray, (c, r), flags=flags)[0]:
            return f"{c} x {r}"
    return ""
