"""The picture as the level view shows it, turned so that the ceiling's lines run along its rows and columns."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.camera import LevelView
from ceilvo.daemon.vision.kernel.arguments import LOOKUP_STEP_PX
from ceilvo.daemon.vision.rolling_shutter import Readout
from ceilvo.types import Array

Bools = NDArray[np.bool_]
Gray = NDArray[np.uint8]

STEEPEST_DEG = 55.0
"""Off the vertical; chosen: a groove of 8 mm is a third as wide there as overhead, and the picture stays small."""
_INVERTIBLE_PX = 0.5
"""A lens is invertible where a level pixel comes back to within this; chosen: folds are off by far more."""
_CELL_PX = 4
"""Every so many pixels a lens is asked whether it is invertible; chosen: folds are broad, and the question is slow."""
_COARSE_PX = 4
"""Every so many pixels a lens is followed; chosen: it bends lines by less than 1/100 px in between."""
_ROWS = 8 * _CELL_PX
"""So many at once; chosen: what is in between stays in the processor's cache."""
_BRIGHT = 240
"""Grey level from which a pixel is of a lamp; chosen: below what saturates, for lenses and compression soften it."""
_GLARE_DEG = 0.7
"""Around lamps where nothing is looked for, 5 px of a camera with a focal length of 410 px; chosen: a lens' blur."""


@dataclass(frozen=True, slots=True)
class Aligned:
    """A picture whose columns lie along the normal of axis 0 and whose rows lie along that of axis 1.

    Attributes:
        gray: (H, W).
        usable: (H, W) 255 where the ceiling is seen, else 0.
        origin_px: (2,) column and row of the level view's principal point.
        psi_rad, tilt_rad: what it was turned by, and (2,) the tilt that was taken off.
    """

    gray: Gray
    usable: Gray
    origin_px: Array
    psi_rad: float
    tilt_rad: Array


class LevelPicture:
    """Level views of the frames of one camera; the look-up is made once."""

    def __init__(self, calibration: Calibration, max_view_deg: float) -> None:
        self._view = view = calibration.level_view
        self.focal_px = view.focal_px
        seen = view.lookup(min(max_view_deg, STEEPEST_DEG), LOOKUP_STEP_PX)
        low, high = (np.rint(f(seen, axis=(0, 1))).astype(np.int64) for f in (np.nanmin, np.nanmax))
        self._low, self._high = low.astype(np.float64), high.astype(np.float64)
        self._x, self._y = x, y = [np.arange(a, b + 1, dtype=np.float64) for a, b in zip(low, high, strict=True)]
        height, width = view.camera.height_px // view.reduction, view.camera.width_px // view.reduction
        (across, down), near = _reduced_px(view, x, y), _invertible(view, x, y)
        reach_px = self.focal_px * np.tan(np.radians(min(max_view_deg, STEEPEST_DEG)))
        shape = len(y), len(x)
        self._known = np.zeros(shape, np.uint8)
        self._maps = np.empty((*shape, 2), np.int16), np.empty(shape, np.uint16)
        for k in range(0, len(y), _ROWS):  # memory that is touched once costs more than sums
            rows, bands = slice(k, k + _ROWS), slice(k // _CELL_PX, (k + _ROWS) // _CELL_PX)
            at = np.tensordot(down[rows], across, 1)
            known = near[bands].repeat(_CELL_PX, axis=0)[: len(at)] & np.all(
                (at > 1.0) & (at < [width - 2.0, height - 2.0]), axis=2
            )
            known &= np.hypot(x, y[rows, None]) < reach_px
            at[~known] = -1.0
            table = at.astype(np.float32)
            self._maps[0][rows], self._maps[1][rows] = cv2.convertMaps(table[..., 0], table[..., 1], cv2.CV_16SC2)
            self._known[rows] = 255 * known
        side = 2 * round(np.radians(_GLARE_DEG) * self.focal_px) + 1
        self._glare = np.ones((side, side), np.uint8)

    def __call__(self, gray: Gray, readout: Readout | None = None) -> tuple[Gray, Gray]:
        """The level view of a frame (H, W) of the calibrated size, and where it shows the ceiling and no lamp.

        Args:
            readout: of a rolling shutter, whose rows are moved to one instant.
        """
        level = cv2.remap(self._view.reduced(gray), self._maps[0], self._maps[1], cv2.INTER_LINEAR)
        known = self._known
        if readout is not None:
            x, y = readout.read_at(self._x, self._y, self.focal_px)
            x, y = x - np.float32(self._x[0]), y - np.float32(self._y[0])
            level = cv2.remap(level, x, y, cv2.INTER_LINEAR)
            known = np.asarray(cv2.remap(known, x, y, cv2.INTER_NEAREST), np.uint8)
        lamps = cv2.dilate(np.uint8(255) * (np.asarray(level) >= _BRIGHT), self._glare)
        return np.asarray(level, np.uint8), np.asarray(cv2.subtract(known, lamps), np.uint8)

    def aligned(self, level: Gray, usable: Gray, psi_rad: float, tilt_rad: Array) -> Aligned:
        """Both turned back by a direction, and by a tilt (2,)."""
        turn = np.linalg.inv(rays_from_aligned(psi_rad, tilt_rad))
        scale = np.diag([self.focal_px, self.focal_px, 1.0])
        x, y = np.meshgrid([self._low[0], self._high[0]], [self._low[1], self._high[1]])
        corners = turn @ np.stack([x.ravel() / self.focal_px, y.ravel() / self.focal_px, np.ones(4)])
        at = corners[:2] / corners[2] * self.focal_px
        low = np.floor(at.min(axis=1))
        width, height = (np.ceil(at.max(axis=1)) - low + 1.0).astype(int).tolist()
        into = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]])
        out_of = np.array([[1.0, 0.0, self._low[0]], [0.0, 1.0, self._low[1]], [0.0, 0.0, 1.0]])
        h = into @ scale @ turn @ np.linalg.inv(scale) @ out_of
        size = width, height
        return Aligned(
            np.asarray(cv2.warpPerspective(level, h, size, flags=cv2.INTER_LINEAR), np.uint8),
            np.asarray(cv2.warpPerspective(usable, h, size, flags=cv2.INTER_NEAREST), np.uint8),
            -low,
            psi_rad,
            tilt_rad,
        )


def _reduced_px(view: LevelView, x: Array, y: Array) -> tuple[Array, Array]:
    """Where the reduced picture shows level pixels, x (W,) and y (H,) from the principal point: (N, W, 2) at some rows,
    and the shares (H, N) of those in each row."""
    some_x, some_y = (np.append(v[:-1:_COARSE_PX], v[-1]) for v in (x, y))
    level = np.stack(np.meshgrid(some_x, some_y), -1).reshape(-1, 2)
    raw = view.to_raw(level + np.array([view.camera.cx_px, view.camera.cy_px]))
    at = view.reduced_px(raw).reshape(len(some_y), len(some_x), 2)
    return np.asarray(np.einsum("xj,ijk->ixk", _between(some_x, x), at, optimize=True)), _between(some_y, y)


def _between(at: Array, wanted: Array) -> Array:
    """(M, N) shares of values at rising places (N,) in those at wanted places (M,), linearly."""
    i = np.clip(np.searchsorted(at, wanted, side="right") - 1, 0, len(at) - 2)
    share = (wanted - at[i]) / (at[i + 1] - at[i])
    rows, shares = np.arange(len(wanted)), np.zeros((len(wanted), len(at)))
    shares[rows, i], shares[rows, i + 1] = 1.0 - share, share
    return shares


def _invertible(view: LevelView, x: Array, y: Array) -> Bools:
    """(M, W) whether the lens is, at level pixels x (W,) and M bands of _CELL_PX of the rows y: looked up at every
    _CELL_PX-th pixel and so for those beside."""
    centre = np.array([view.camera.cx_px, view.camera.cy_px])
    some = np.stack(np.meshgrid(x[::_CELL_PX], y[::_CELL_PX]), -1)
    raw = view.to_raw(some.reshape(-1, 2) + centre)
    back = view.from_raw(np.nan_to_num(raw, nan=-1.0)) - centre
    known = (np.hypot(*(back - some.reshape(-1, 2)).T) < _INVERTIBLE_PX).reshape(some.shape[:2])
    return np.asarray(known.repeat(_CELL_PX, axis=1)[:, : len(x)])


def rays_from_aligned(psi_rad: float, tilt_rad: Array) -> Array:
    """(3, 3): rays that a robot tilted by tilt_rad (2,) saw, from (across axis 0, across axis 1, 1) of a level one."""
    a, b = tilt_rad.tolist()
    c, s = np.cos(psi_rad), np.sin(psi_rad)
    level = np.array([[1.0, 0.0, b], [0.0, 1.0, -a], [-b, a, 1.0]])
    return np.asarray(np.linalg.inv(level) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))
