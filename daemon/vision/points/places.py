"""Where pixels of the picture lie in the level view, with how it stretches there."""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.daemon.vision.edges import interpolated
from ceilvo.daemon.vision.kernel.arguments import LOOKUP_STEP_PX
from ceilvo.types import Array, Ints

Gray = NDArray[np.uint8]

_BAND = 16
"""Rows of the picture whose places are made at once; chosen: a lamp spans a few of them."""


@dataclass(frozen=True, slots=True)
class Found:
    """Points of a picture.

    Attributes:
        uv: (N, 2) in the level view, px from its principal point, the robot's tilt not taken off.
        cov: (N, 2, 2) px^2.
        kind: (N,) LAMP, SPOT or CORNER of ceilvo.crossing_types.
        row: (N,) of the picture that is looked at.
    """

    uv: Array
    cov: Array
    kind: Ints
    row: Array

    def __len__(self) -> int:
        return len(self.kind)

    def of(self, which: NDArray[np.bool_] | Ints) -> Found:
        return Found(self.uv[which], self.cov[which], self.kind[which], self.row[which])


NONE = Found(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, np.int64), np.zeros(0))


def denoised(gray: Gray) -> Gray:
    """A picture (H, W) smoothed over 5 pixels: what stands out of it is no noise."""
    return np.asarray(cv2.GaussianBlur(gray, (5, 5), 0), np.uint8)


def joined(parts: list[Found]) -> Found:
    """All of them, in order."""
    return Found(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Found)))


class Places:
    """The level view's coordinates of one camera's pixels, as the picture is looked at (LevelView.reduced)."""

    def __init__(self, calibration: Calibration, max_view_deg: float) -> None:
        self.view = calibration.level_view
        camera, k = self.view.camera, self.view.reduction
        self.width, self.height = camera.width_px // k, camera.height_px // k
        self._max_view_deg = max_view_deg
        self._table = np.empty((self.height, self.width, 2), np.float32)  # as the look-up is
        self._made = np.zeros(-(-self.height // _BAND), np.bool_)
        seen = np.isfinite(self.view.lookup(max_view_deg, LOOKUP_STEP_PX)[..., 0])
        self.known: Gray = np.uint8(255) * interpolated(seen, (self.height, self.width))

    def window(self, rows: slice, columns: slice) -> tuple[Array, Array]:
        """(h, w, 2) level pixels and (h, w) the area of each of a window's pixels there."""
        top, left = max(rows.start - 1, 0), max(columns.start - 1, 0)
        self._make(np.arange(top // _BAND, min(rows.stop, self.height - 1) // _BAND + 1))
        around = self._table[top : rows.stop + 1, left : columns.stop + 1].astype(np.float64)
        down, right = np.gradient(around, axis=0), np.gradient(around, axis=1)
        area = np.abs(right[..., 0] * down[..., 1] - right[..., 1] * down[..., 0])
        inner = slice(rows.start - top, rows.stop - top), slice(columns.start - left, columns.stop - left)
        return around[inner], area[inner]

    def _make(self, bands: Ints) -> None:
        """The table where it is looked at: the whole takes as long as ten frames."""
        for band in bands[~self._made[bands]].tolist():
            first, last = band * _BAND, min((band + 1) * _BAND, self.height)
            self._table[first:last] = self.view.rows_of_lookup(self._max_view_deg, 1, first, last)[:, : self.width]
            self._made[band] = True

    def at(self, pixels: Array) -> tuple[Array, Array]:
        """(N, 2) level pixels of pixels (N, 2), and (N, 2, 2) their change with a pixel's; nan where not known."""
        column = np.clip(np.floor(pixels[:, 0]).astype(np.int64), 0, self.width - 2)
        row = np.clip(np.floor(pixels[:, 1]).astype(np.int64), 0, self.height - 2)
        self._make(np.unique(np.concatenate([row, row + 1]) // _BAND))
        fx, fy = (pixels - np.column_stack([column, row])).T[:, :, None]
        corners = ((row, column), (row, column + 1), (row + 1, column), (row + 1, column + 1))
        a, b, c, d = (self._table[at].astype(np.float64) for at in corners)
        uv = (1.0 - fy) * ((1.0 - fx) * a + fx * b) + fy * ((1.0 - fx) * c + fx * d)
        return np.asarray(uv), np.stack([0.5 * (b - a + d - c), 0.5 * (c - a + d - b)], axis=2)

    def found(self, pixels: Array, sigma_px: Array | float, kind: int) -> Found:
        """Points at pixels (N, 2) that are off by sigma_px, a number or (N,)."""
        uv, change = self.at(pixels)
        variance = np.broadcast_to(np.asarray(sigma_px, np.float64) ** 2, len(pixels))
        cov = variance[:, None, None] * (change @ change.transpose(0, 2, 1))
        good = np.all(np.isfinite(cov), axis=(1, 2)) & np.all(np.isfinite(uv), axis=1)
        return Found(uv[good], cov[good], np.full(int(np.count_nonzero(good)), kind, np.int64), pixels[good, 1])
