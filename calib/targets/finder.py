"""Where a board's corners are in a picture, or why the picture is no use."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.targets.board import TAG_BORDERS, Board
from ceilvo.calib.targets.quality import edge_width_px, light_problem, sharpest_edge_px
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Gray = NDArray[np.uint8]

_SOFT_EDGE_PX = 5.0
"""Width of the sharpest edges, 1.5 px in focus; beyond it corners move with the blur."""
_CORNERS = 8
"""For a pose and something left to judge it by."""
_BORDER_PX = 2.0
"""A corner nearer to the picture's edge cannot be refined."""
_ROOM, _ROOM_TO_MARKER = 0.35, 0.4
"""Of a square, and of the gap between marker and square, that a corner's window may reach: the next edge is outside."""
_ROOM_OF_TAG = 0.8
"""Of a tag's border or the gap beside it, likewise."""
_TAG_WINDOW_PX = 4
"""Half side of the window in which a tag's corner is looked for first: it is up to 3.6 px off on pictures of 640 px."""
_WINDOWS_PX = (2, 11)
"""Half side of the window, least and most; OpenCV's own pictures were made with 11 (docs/calibration.md)."""
_REFINE_STEPS, _REFINE_PX = 40, 1e-3
"""cornerSubPix ends after so many steps, or when a step is smaller."""
_AROUND_PX = 5
"""Of the board, that its sharpness is judged on as well."""
_LEAST_PX = 48
"""Of a picture's shorter side: four squares would have 10 px; OpenCV enlarges smaller pictures for seconds."""
_BLOB_PX2 = (12.0, 0.1)
"""Area of a circle: px^2 at the least, and of the picture at the most."""


@dataclass(frozen=True)
class Sighting:
    """Corners in a picture: ids (N,) into Board.corners_m and uv_px (N, 2), or none with the reason."""

    ids: Ints
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
        self._charuco = cv2.aruco.CharucoDetector(board.charuco) if board.kind == "charuco" else None
        self._tags = [_marker_detector(board, b) for b in TAG_BORDERS] if board.kind == "aprilgrid" else []

    def __call__(self, gray: Gray) -> Sighting:
        reason = light_problem(gray)
        if reason:
            return _nothing(reason)
        ids, uv = self._corners(gray)
        if len(ids) == 0:
            width = sharpest_edge_px(gray)
            if width > _SOFT_EDGE_PX:
                return _nothing(f"blurred: edges are {width:.1f} px wide; hold still, focus, more light")
            markers = markers_seen(self.board, gray)
            if markers:
                return _nothing(f"board not seen, although {markers} of its markers are: see --columns and --rows")
            return _nothing("board not seen" if self.board.marked else "board not seen as a whole")
        if len(ids) < _CORNERS:
            return _nothing(f"only {len(ids)} corners seen, {_CORNERS} needed")
        h, w = gray.shape
        low, high = uv.min(axis=0), uv.max(axis=0)
        if (low < _BORDER_PX).any() or (high > np.array([w, h]) - 1 - _BORDER_PX).any():
            return _nothing("a corner lies on the picture's edge")
        x0, y0 = np.maximum(low.astype(int) - _AROUND_PX, 0)
        width = edge_width_px(gray[y0 : int(high[1]) + _AROUND_PX + 1, x0 : int(high[0]) + _AROUND_PX + 1])
        if width > _SOFT_EDGE_PX:
            return _nothing(f"blurred: the board's edges are {width:.1f} px wide; hold still, focus, more light")
        return Sighting(ids, uv if self.board.kind in ("circles", "acircles") else self._refine(gray, uv))

    def _corners(self, gray: Gray) -> tuple[Ints, Array]:
        if self.board.kind == "chessboard":
            return _every(_chessboard(gray, (self.board.columns, self.board.rows)))
        if self.board.kind == "charuco":
            return self._charuco_corners(gray)
        if self.board.kind == "aprilgrid":
            return max((self._tag_corners(gray, d) for d in self._tags), key=lambda found: len(found[0]))
        return _every(_circles(gray, self.board))

    def _charuco_corners(self, gray: Gray) -> tuple[Ints, Array]:
        if self._charuco is None:
            return _every(None)
        corners, ids, _, _ = self._charuco.detectBoard(gray)
        if np.size(ids) == 0 or np.ndim(corners) == 0:  # None in some versions
            return _every(None)
        return np.asarray(ids, np.int64).reshape(-1), np.asarray(corners, np.float64).reshape(-1, 2)

    def _tag_corners(self, gray: Gray, detector: cv2.aruco.ArucoDetector) -> tuple[Ints, Array]:
        """Corners of the tags that are seen, whichever way up the tags were printed and numbered."""
        quads, numbers, _ = detector.detectMarkers(gray)
        tags = np.zeros(0, np.int64) if numbers is None else np.ravel(numbers).astype(np.int64)
        mine = np.flatnonzero(tags < self.board.columns * self.board.rows)
        if len(mine) < 2:
            return _every(None)
        uv = np.array([np.asarray(quads[int(i)], np.float64).reshape(4, 2) for i in mine])
        best: tuple[float, Ints] | None = None
        for turn, upwards in itertools.product(range(4), (True, False)):
            row, column = np.divmod(tags[mine], self.board.columns)
            cell = (row if upwards else self.board.rows - 1 - row) * self.board.columns + column
            ids = 4 * cell[:, None] + (np.arange(4) + turn) % 4
            xy = self.board.corners_m[ids.ravel(), :2]
            h: Array | None = cv2.findHomography(xy, uv.reshape(-1, 2))[0]  # type: ignore[assignment]
            if h is None:
                continue
            p = np.column_stack([xy, np.ones(len(xy))]) @ h.T
            off = float(np.median(np.hypot(*(p[:, :2] / p[:, 2:] - uv.reshape(-1, 2)).T)))
            if best is None or off < best[0]:
                best = off, ids.ravel()
        if best is None:
            return _every(None)
        return best[1], uv.reshape(-1, 2)

    def _refine(self, gray: Gray, uv: Array) -> Array:
        board, room = self.board, _ROOM
        if board.kind == "charuco":
            room = _ROOM_TO_MARKER * (board.square_m - board.marker_m) / board.square_m
        if board.kind == "aprilgrid":
            gap, border = (
                board.square_m - board.marker_m,
                TAG_BORDERS[1] * board.marker_m / (board.words.markerSize + 2),
            )
            room = _ROOM_OF_TAG * min(gap, border) / min(gap, board.marker_m)
        window = self._window or int(np.clip(room * _spacing_px(uv), *_WINDOWS_PX))
        if board.kind == "aprilgrid":  # OpenCV finds tags too small, for squares touch their corners
            near = _refined(gray, uv, max(window, _TAG_WINDOW_PX)).reshape(-1, 4, 2)
            quads = uv.reshape(-1, 4, 2)
            middle = quads.mean(axis=1, keepdims=True)
            grown = np.median(np.linalg.norm(near - middle, axis=2) / np.linalg.norm(quads - middle, axis=2))
            uv = (middle + grown * (quads - middle)).reshape(-1, 2)
        return _refined(gray, uv, window)


def _refined(gray: Gray, uv: Array, window: int) -> Array:
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _REFINE_STEPS, _REFINE_PX)
    corners = uv.astype(np.float32).reshape(-1, 1, 2)
    return np.asarray(cv2.cornerSubPix(gray, corners, (window, window), (-1, -1), until), np.float64).reshape(-1, 2)


def _every(uv: Array | None) -> tuple[Ints, Array]:
    """All corners in order, or none."""
    if uv is None:
        return np.zeros(0, np.int64), np.zeros((0, 2))
    return np.arange(len(uv)), uv


def _chessboard(gray: Gray, size: tuple[int, int]) -> Array | None:
    """The quick search where OpenCV's check says that there may be a board, the thorough one else.

    The check misses boards that lean or lie near the rim; without it the quick search takes seconds on a picture
    without a board, the thorough one does not.
    """
    if min(gray.shape) < _LEAST_PX:
        return None
    if cv2.checkChessboard(gray, size):
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(gray, size, flags=flags)
        if found:
            return np.asarray(corners, np.float64).reshape(-1, 2)
    found, corners = cv2.findChessboardCornersSB(gray, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    return np.asarray(corners, np.float64).reshape(-1, 2) if found else None


def _circles(gray: Gray, board: Board) -> Array | None:
    p = cv2.SimpleBlobDetector_Params()  # type: ignore[attr-defined]
    p.minArea, p.maxArea = _BLOB_PX2[0], _BLOB_PX2[1] * gray.size
    blobs = cv2.SimpleBlobDetector_create(p)  # type: ignore[attr-defined]
    kind = cv2.CALIB_CB_SYMMETRIC_GRID if board.kind == "circles" else cv2.CALIB_CB_ASYMMETRIC_GRID
    for more in (0, cv2.CALIB_CB_CLUSTERING):
        found, centres = cv2.findCirclesGrid(gray, (board.columns, board.rows), flags=kind | more, blobDetector=blobs)
        if found:
            return np.asarray(centres, np.float64).reshape(-1, 2)
    return None


def _marker_detector(board: Board, border: int) -> cv2.aruco.ArucoDetector:
    p = cv2.aruco.DetectorParameters()
    p.markerBorderBits = border
    p.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    return cv2.aruco.ArucoDetector(board.words, p)


def _spacing_px(uv: Array) -> float:
    """Distance to the nearest other corner, the smallest in the picture."""
    d = np.hypot(*(uv[:, None] - uv[None]).transpose(2, 0, 1))
    d[np.diag_indices(len(d))] = np.inf
    return float(d.min())


def markers_seen(board: Board, gray: Gray) -> int:
    """How many markers of the board's dictionary are in a picture, whatever their places."""
    if not board.marked:
        return 0
    found = (_marker_detector(board, b).detectMarkers(gray)[1] for b in TAG_BORDERS)
    return max(0 if numbers is None else len(numbers) for numbers in found)


def other_board(board: Board, gray: Gray) -> str:
    """The board of the same kind that is in the picture instead, with the options that name it; "" if there is none."""
    if board.kind == "charuco":
        return _other_charuco(board, gray)
    if board.kind != "chessboard":
        return ""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    sizes = ((c, r) for c in range(12, 2, -1) for r in range(c, 2, -1))
    for c, r in sizes:  # the largest first: a part of a board is a board as well
        if cv2.findChessboardCorners(gray, (c, r), flags=flags)[0]:
            return f"{c} x {r} inner corners, expected {board.columns} x {board.rows}; give --columns and --rows"
    return ""


def _other_charuco(board: Board, gray: Gray) -> str:
    """Columns and rows swapped, the pattern of before OpenCV 4.6, or both: the one of which most is seen."""
    best = 0, ""
    for swapped, legacy in ((True, board.legacy), (False, not board.legacy), (True, not board.legacy)):
        c, r = (board.rows, board.columns) if swapped else (board.columns, board.rows)
        try:
            other = replace(board, columns=c, rows=r, legacy=legacy)
        except CalibrationError:
            continue
        corners, ids, _, _ = cv2.aruco.CharucoDetector(other.charuco).detectBoard(gray)
        seen = 0 if np.ndim(corners) == 0 else int(np.size(ids))
        if seen > best[0]:
            how = "--legacy" if legacy else ("" if not board.legacy else "no --legacy")
            way = f"{c} x {r} squares{', legacy pattern' if legacy else ''}"
            best = seen, f"{way}, expected {board.columns} x {board.rows}; give --columns {c} --rows {r} {how}".rstrip()
    return best[1] if best[0] >= _CORNERS else ""
