"""A judge of two paths that neither made: lamps that hang on a grid of known pitch must be found on it.

Lamps are bright spots of the frames, placed on the ceiling by their outlines' centres; no lines, no crossings.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calibration import Calibration, to_ceiling
from ceilvo.types import Array

_BRIGHT = 127  # grey level; half of 255, as the frames hold 0 and 255 alone (SOURCE.txt)
_FEWEST_PX = 25  # of an outline; chosen: smaller spots are specks
_BORDER_PX = 4  # chosen: a lamp that comes nearer may be cut off
_FARTHEST_M = 3.2  # from the base; chosen: beyond it a fisheye shows a lamp too flat for a centre
_AREA_RATIO = 1.35  # to the median lamp, either way; chosen: two lamps in one, or half a one, are out
_SMALLEST_M2 = 1e-4  # chosen: a square centimetre, guards the division by the area
_SAME_LAMP_M = 0.4  # in two frames; chosen: far below the 3 m from one lamp to the next


@dataclass(frozen=True)
class Lamps:
    """Lamps seen: of which frame (N,), and where in base, xy_m (N, 2)."""

    frame: NDArray[np.int64]
    xy_m: Array


@dataclass(frozen=True)
class Judged:
    """How well a path puts lamps where lamps hang.

    Attributes:
        off_m: rms distance from the nearest node of the grid.
        stretch: by how much of the way lamps drift off it, along the axis of the longer way.
        step_m: median movement of a lamp from frame to frame; lamps do not move.
    """

    off_m: float
    stretch: float
    step_m: float


def seen(frames: Iterable[NDArray[np.uint8]], calibration: Calibration) -> Lamps:
    """Whole lamps of the usual size; those cut off by the picture's border or far away are left out."""
    found: list[tuple[int, float, float, float]] = []
    for k, gray in enumerate(frames):
        outlines, _ = cv2.findContours(np.uint8(1) * (gray > _BRIGHT), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        found += [(k, *place) for o in outlines if (place := _place(o[:, 0], gray.shape, calibration)) is not None]
    table = np.array(found, np.float64).reshape(-1, 4)
    ratio = table[:, 3] / np.median(table[:, 3]) if len(table) else table[:, 3]
    table = table[(ratio < _AREA_RATIO) & (ratio > 1.0 / _AREA_RATIO)]
    return Lamps(table[:, 0].astype(np.int64), table[:, 1:3])


def _place(
    outline: NDArray[np.int32], shape: tuple[int, ...], calibration: Calibration
) -> tuple[float, float, float] | None:
    """Centre in base and area, m and m^2, of one outline."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    limit = np.array([shape[1], shape[0]]) - 1 - _BORDER_PX
    if len(outline) < _FEWEST_PX or np.any(low < _BORDER_PX) or np.any(high > limit):
        return None
    level = calibration.level_view.from_raw(outline.astype(np.float64))
    if not np.all(np.isfinite(level)):
        return None
    xy = to_ceiling(calibration.ceiling_from_level, level)
    if float(np.hypot(*xy.T).max()) > _FARTHEST_M:
        return None
    moments = cv2.moments(xy.astype(np.float32)[:, None])
    area = moments["m00"]
    return (moments["m10"] / area, moments["m01"] / area, area) if area > _SMALLEST_M2 else None


def judge(lamps: Lamps, poses: Array, pitch_m: Array) -> Judged:
    """A path (frames, 3) by the lamps seen along it; pitch_m (2,) of the grid along the map's axes."""
    xy = np.array([se2.transform(poses[k], p[None])[0] for k, p in zip(lamps.frame, lamps.xy_m, strict=True)])
    turn = 2.0 * np.pi * xy / pitch_m
    off = np.angle(np.exp(1j * (turn - np.angle(np.mean(np.exp(1j * turn), axis=0))))) * pitch_m / (2.0 * np.pi)
    along = int(np.argmax(np.ptp(poses[:, :2], axis=0)))
    stretch = float(np.polyfit(poses[lamps.frame, along], off[:, along], 1)[0])
    steps: list[float] = []
    for k in np.unique(lamps.frame):
        apart = xy[lamps.frame == k + 1][None] - xy[lamps.frame == k][:, None]
        moved = np.hypot(apart[..., 0], apart[..., 1])
        steps += moved[moved < _SAME_LAMP_M].tolist()
    return Judged(float(np.sqrt(np.mean(np.sum(off**2, axis=1)))), stretch, float(np.median(steps)))
