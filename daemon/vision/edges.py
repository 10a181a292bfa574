"""Stage 1: edge points, to sub-pixel, in the level view (noise-adaptive Canny; points are undistorted, not images)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.camera import LevelView
from ceilvo.config import Features
from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.kernel.arguments import LOOKUP_STEP_PX
from ceilvo.daemon.vision.rolling_shutter import Readout
from ceilvo.robust import LOWER_QUARTILE_TO_SIGMA, MAD_TO_SIGMA
from ceilvo.types import Ints

Array32 = NDArray[np.float32]

_NOISE_STRIDE_PX = 11
"""Every 11th pixel of every 11th row tells the noise, 2600 of 640x480; chosen, prime: few patterns fall in with it."""
_CEILING_DEG = 55.0
"""Off the vertical, beyond which pixels do not tell the noise; chosen: there walls, rims and clutter begin."""
_FEWEST_SAMPLES = 100
"""Pixels that tell the noise; chosen: of fewer the median is off by a tenth. A camera that leans further takes all."""
_SLOPE_LEVEL = 1.0
"""Slopes of pixels are whole numbers; so much is added to the lower quartile, that a quiet picture's is not too low."""
_TEXTURE_RATIO = 1.5
"""Noise by the median of slopes over that by their lower quartile and a level, up to which it is a texture's: 1 at most
of tiles, fibre and photographs, 1.3 of wood; 2.1 to 2.5 of open cells seen askew, whose lines it would hide."""
_RANKS = (1 << 16) - 1
"""Ranks of pixels by which a frame is thinned: what the uint16 of kernel.level_points holds."""


@dataclass(frozen=True, slots=True)
class Edges:
    """Edge points.

    Attributes:
        uv_px: (P, 2) in the level view, relative to its principal point.
        phi_deg: (P,) direction of the gradient, along which brightness rises, in [0, 360).
        fraction: of the edge points found, how many these are; a frame with very many is sampled uniformly.
    """

    uv_px: Array32
    phi_deg: Array32
    fraction: float = 1.0


class EdgeDetector:
    """Finds edge points in raw frames of one camera; the look-up to the level view is made once."""

    def __init__(self, calibration: Calibration, config: Features) -> None:
        self._config = config
        self._view = view = calibration.level_view
        self._lookup = view.lookup(config.max_view_deg, LOOKUP_STEP_PX)
        self._samples = noise_samples(view, config.max_view_deg)
        shape = view.camera.height_px // view.reduction, view.camera.width_px // view.reduction
        usable = interpolated(np.isfinite(self._lookup[..., 0]), shape)
        usable[[0, -1], :] = False
        usable[:, [0, -1]] = False
        self._usable = usable.astype(np.uint8) * 255
        # of every frame the same room: memory that the system gives anew costs as much as what is put there
        self._framed, self._mask = framed_room(view), np.empty(shape, np.uint8)
        self._gradient = np.empty(shape, np.int16), np.empty(shape, np.int16)
        # a fixed, patternless order of the pixels: a regular one would favour lines at some angle
        rank = np.random.default_rng(0).permutation(usable.size) * _RANKS // usable.size
        self._rank = rank.astype(np.uint16).reshape(shape)

    def __call__(self, gray: NDArray[np.uint8], readout: Readout | None = None) -> Edges:
        """Edge points of a (H, W) frame of the calibrated size, at the instant of its middle row."""
        framed = smoothed(self._view.reduced(gray), self._config, self._framed)
        dx, dy = (np.asarray(d, np.int16) for d in cv2.spatialGradient(framed[1:-1, 1:-1], *self._gradient))
        low, high = thresholds(framed, self._config, self._samples)
        mask = cv2.Canny(dx, dy, low, high, self._mask, L2gradient=True)
        edges = np.asarray(cv2.bitwise_and(mask, self._usable, self._mask), np.uint8)
        limit, fraction = self._limit(cv2.countNonZero(edges))
        rows = None if readout is None else readout.rows
        uv, phi = kernel.level_points(edges, dx, dy, self._lookup, self._rank, limit, rows)
        return Edges(uv, phi, fraction)

    def _limit(self, found: int) -> tuple[int, float]:
        """Rank below which pixels are kept, and the fraction of `found` edge points that this keeps."""
        fraction = self._config.max_edge_share * self._usable.size / max(found, 1)
        return (_RANKS, 1.0) if fraction >= 1.0 else (int(fraction * _RANKS), fraction)


def noise_samples(view: LevelView, max_view_deg: float) -> Ints:
    """(S,) pixels of a reduced picture, row after row, that tell the noise: an even raster of those of the ceiling."""
    height, width = view.camera.height_px // view.reduction, view.camera.width_px // view.reduction
    rows, columns = range(0, height, _NOISE_STRIDE_PX), range(0, width, _NOISE_STRIDE_PX)
    at = np.add.outer(width * np.array(rows), np.array(columns))
    for most_deg in (min(_CEILING_DEG, max_view_deg), max_view_deg):
        seen = np.isfinite(view.lookup(most_deg, _NOISE_STRIDE_PX)[: len(rows), : len(columns), 0])
        if np.count_nonzero(seen) >= _FEWEST_SAMPLES:
            return np.asarray(at[seen], np.int64)
    return np.asarray(at.reshape(-1), np.int64)


def framed_room(view: LevelView) -> NDArray[np.uint8]:
    """(H + 2, W + 2) not set: where smoothed() puts frames of this camera."""
    return np.empty((view.camera.height_px // view.reduction + 2, view.camera.width_px // view.reduction + 2), np.uint8)


def smoothed(gray: NDArray[np.uint8], config: Features, room: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H + 2, W + 2) the frame (H, W) without the finest noise, and around it a frame of one pixel, in `room`."""
    inner = room[1:-1, 1:-1]
    inner[...] = cv2.GaussianBlur(gray, (config.smoothing_px, config.smoothing_px), 0, inner)  # itself, where it can
    room[0], room[-1] = room[2], room[-3]
    room[:, 0], room[:, -1] = room[:, 2], room[:, -3]
    return room


def thresholds(framed: NDArray[np.uint8], config: Features, samples: Ints) -> tuple[float, float]:
    """Lower and upper threshold of the gradient that a frame's noise asks for.

    The median tells the noise, unless most pixels stand on edges, as of open cells seen askew: then the lower quartile.

    Args:
        framed: as of smoothed().
        samples: as of noise_samples().
    """
    lower, middle = kernel.slope_quartiles(framed, samples)
    sigma = min(MAD_TO_SIGMA * middle, _TEXTURE_RATIO * LOWER_QUARTILE_TO_SIGMA * (lower + _SLOPE_LEVEL))
    high = max(config.canny_sigmas * sigma, config.canny_floor)
    return config.canny_low_ratio * high, high


def interpolated(known: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """(H, W) pixels all four corners of whose cell of the look-up are known; the last of an odd width has no cell."""
    cell = known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]
    fine = cell.repeat(LOOKUP_STEP_PX, axis=0).repeat(LOOKUP_STEP_PX, axis=1)[: shape[0], : shape[1]]
    out = np.zeros(shape, np.bool_)
    out[: fine.shape[0], : fine.shape[1]] = fine
    return out
