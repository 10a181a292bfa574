"""Innovations drawn over the picture: how far off the map and the predicted pose each crossing is seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.calibration import to_ceiling as projected
from ceilvo.daemon.replay.drawing.overlay import VERMILION, WHITE, Canvas, tilted
from ceilvo.types import Crossings, Landmarks

Array = NDArray[np.float64]

ENLARGED = 20.0
"""Times as long as they are; chosen: a millimetre under a ceiling of 2.2 m is a fifth of a pixel."""
_REACH_M = 0.05
"""Within which a landmark of the same type is the crossing; chosen: an innovation of TRACKING is far below it."""
_RING_PX = 7.0


def within_reach(crossings: Crossings, landmarks: Landmarks, pose: Array) -> NDArray[np.bool_]:
    """(L,) of the landmarks those that any innovation can be from, and no more than the view's size needs.

    Args:
        pose: as innovations_px().
    """
    seen_m = np.hypot(*crossings.xy_base_m.T).max(initial=0.0) + _REACH_M
    return np.asarray(np.hypot(*(landmarks.xy_map_m - pose[:2]).T) <= seen_m, np.bool_)


def innovations_px(crossings: Crossings, landmarks: Landmarks, pose: Array, calibration: Calibration) -> Array:
    """(M, 2) level pixels from where each crossing was expected to where it is seen; nan where none was expected.

    Args:
        pose: (3,) map_from_base as predicted, before the view was taken into account.
    """
    out = np.full((len(crossings), 2), np.nan)
    if not len(crossings) or not len(landmarks):
        return out
    expected = se2.transform(se2.inverse(pose), landmarks.xy_map_m)
    off = crossings.xy_base_m[:, None] - expected[None]
    distance = np.hypot(off[..., 0], off[..., 1])
    distance[crossings.crossing_type[:, None] != landmarks.crossing_type[None]] = np.inf
    nearest = np.argmin(distance, axis=1)
    known = distance[np.arange(len(crossings)), nearest] < _REACH_M
    level_from_ceiling = calibration.level_from_ceiling
    there = projected(level_from_ceiling, crossings.xy_base_m[known])
    out[known] = there - projected(level_from_ceiling, expected[nearest[known]])
    return out


def draw_innovations(
    image: NDArray[np.uint8], crossings: Crossings, landmarks: Landmarks, pose: Array, calibration: Calibration
) -> None:
    """Arrows on a picture (H, W, 3), ENLARGED times as long as the innovations, and a ring about what was expected."""
    canvas, level = Canvas(image), calibration.level_view
    off = innovations_px(crossings, landmarks, pose, calibration)
    raw = level.to_raw(tilted(crossings.uv_px, crossings.tilt_rad, level))
    for at, d in zip(raw, off, strict=True):
        if np.isfinite(at).all() and np.isfinite(d).all():
            canvas.disc(at, _RING_PX, WHITE, 1)
            canvas.arrow(at, at + ENLARGED * d, VERMILION, 2)
    canvas.text(6, len(image) - 8, f"innovations x {ENLARGED:.0f}")
