"""Whether a picture is any use: its light and its sharpness."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]

_SATURATED, _SATURATED_FRACTION = 253, 0.25
"""Grey level of white, and how much of a picture may have it; chosen: a lamp may be in the picture."""
_DARK = 18.0
"""Grey level of the brightest hundredth; chosen."""
_SOBEL = 0.125
"""Scale under which a Sobel filter gives grey levels a pixel."""
_STEEP_PERCENTILE, _BRIGHT_PERCENTILE, _DARK_PERCENTILE = 99.8, 98, 2
"""Of gradients and of grey levels, instead of the extremes, which are noise."""
_FLAT_PICTURE = 0.5
"""Steepest gradient, grey levels a pixel, of a picture with nothing in it."""
_BESIDE_PX = 15
"""On either side of an edge that its own contrast is looked for; three times the width of one that is called soft."""
_JUDGED = 40.0
"""Grey levels across an edge below which a picture has none to be judged by; chosen: far above noise and shadows."""


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
    dx = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=_SOBEL))
    dy = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=_SOBEL))
    steepest = float(np.percentile(np.hypot(dx, dy), _STEEP_PERCENTILE))
    contrast = float(np.percentile(soft, _BRIGHT_PERCENTILE)) - float(np.percentile(soft, _DARK_PERCENTILE))
    return contrast / steepest if steepest > _FLAT_PICTURE else np.inf


def sharpest_edge_px(gray: Gray) -> float:
    """Width of the sharpest edges by each edge's own contrast, 0 where there is none to judge by.

    edge_width_px() takes the whole picture's contrast, which is right for a board and calls a sharp picture of faint
    things soft.
    """
    soft = cv2.GaussianBlur(gray, (3, 3), 0)
    dx = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 1, 0, scale=_SOBEL))
    dy = np.asarray(cv2.Sobel(soft, cv2.CV_32F, 0, 1, scale=_SOBEL))
    gradient = np.hypot(dx, dy)
    around = np.ones((2 * _BESIDE_PX + 1,) * 2, np.uint8)
    contrast = np.asarray(cv2.dilate(soft, around), np.float32) - np.asarray(cv2.erode(soft, around), np.float32)
    steep = (
        (gradient >= np.percentile(gradient, _STEEP_PERCENTILE)) & (contrast >= _JUDGED) & (gradient > _FLAT_PICTURE)
    )
    return float(np.median(contrast[steep] / gradient[steep])) if steep.any() else 0.0
