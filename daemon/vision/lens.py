"""What a lens makes of a groove: how far apart its sides seem to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.camera import LevelView
from ceilvo.config import Features
from ceilvo.daemon.vision.line_pairing import BLURRED_PX
from ceilvo.types import Array

_AZIMUTHS = 16
_MOST_BLURRED_PX = 7.0
"""However much a level view is stretched; measured: with it a fisheye's grooves are found, 95 % of the crossings, and
with 3.5 px 13 % (bench-vision, fisheye)."""


def stretch(view: LevelView, max_view_deg: float) -> float:
    """Most pixels of the level view that one pixel of the picture, as it is looked at, takes on the way outwards.

    1 for a pinhole that looks straight up, 2 for an equidistant fisheye 45 deg off the vertical.

    Args:
        max_view_deg: rays further off the vertical are ignored.
    """
    camera, step_px = view.camera, 1.0
    angle = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    out = np.column_stack([np.cos(angle), np.sin(angle)])
    farthest_px = view.focal_px * np.tan(np.radians(max_view_deg))
    most = 1.0
    for radius_px in np.arange(0.0, farthest_px, max(0.05 * view.focal_px, step_px)):
        at = np.array([camera.cx_px, camera.cy_px]) + radius_px * out
        raw, beyond = (view.reduced_px(view.to_raw(p)) for p in (at, at + step_px * out))
        inside = _inside(view, raw) & _inside(view, beyond)
        if np.any(inside):
            most = max(most, step_px / float(np.min(np.hypot(*(beyond - raw)[inside].T))))
    return most


def _inside(view: LevelView, uv_px: Array) -> NDArray[np.bool_]:
    """(N,) whether pixels (N, 2) are in the picture as it is looked at."""
    size = np.array([view.camera.width_px, view.camera.height_px]) / view.reduction
    return np.asarray(np.all((uv_px > 0.0) & (uv_px < size - 1.0), axis=1))


def for_lens(config: Features, view: LevelView) -> Features:
    """Settings for a camera: blur parts the sides of a groove in the picture, and takes edge points where lines cross;
    a level view stretches that. Settings that are for it already stay."""
    most = stretch(view, config.max_view_deg)
    if most * BLURRED_PX <= np.radians(config.groove_deg) * view.focal_px:
        return config
    seen_px = min(most * BLURRED_PX, _MOST_BLURRED_PX)
    groove_deg = max(config.groove_deg, float(np.degrees(seen_px / view.focal_px)))
    reach_deg = config.crossing_reach_deg * groove_deg / config.groove_deg
    return replace(config, groove_deg=groove_deg, crossing_reach_deg=reach_deg)
