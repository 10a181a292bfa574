"""Angles of the configuration as pixels of a level view, so that one ceiling is the same to cameras of any size."""

from __future__ import annotations

import numpy as np

_DIGITS = 2
"""Of a pixel; chosen: less decides nothing, and angles written with three digits give the pixels that were meant."""


def pixels(angle_deg: float, focal_px: float, least_px: float = 0.0) -> float:
    """How many pixels an angle is in the middle of a level view, at least `least_px`."""
    return max(round(float(np.radians(angle_deg)) * focal_px, _DIGITS), least_px)
