"""Lamps: bright blobs, by the centre of their light, and by their ends where they are long."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from ceilvo.crossing_types import CORNER, LAMP
from ceilvo.daemon.vision.points.lamp_ends import SIGMA_PX as END_SIGMA_PX
from ceilvo.daemon.vision.points.lamp_ends import lamp_ends
from ceilvo.daemon.vision.points.places import NONE, Found, Gray, Places, joined
from ceilvo.types import Array

_STRIDE = 4
"""Every so manieth pixel either way tells how bright the ceiling is; chosen: 19,000 of them do."""
_BRIGHTEST = 0.999
"""Quantile that is a lamp's brightness, if one is in view; chosen: a lamp of 20 x 20 px is 0.13 % of the picture."""
_BRIGHTER = 50.0
"""Grey levels by which a lamp exceeds the ceiling at least; chosen: glow and stains stay below."""
_NOT_NOISE = 0.8
"""Share of that which is left in a denoised picture, where it is a lamp and not the noise of what is bright anyhow;
chosen: of a disc 20 px wide, the least that the quantile sees, .83 are (drawn, without noise)."""
_HALF = 0.5
"""Share of the way from the ceiling to the lamp at which a lamp ends; chosen: its glow on the ceiling lies below."""
_LEAST_PX, _MOST_SHARE = 20, 0.12
"""Area of a lamp, pixels, and as a part of the picture; chosen: smaller ones are specks, larger ones windows."""
_BORDER_PX = 2
"""A blob nearer to the side of the picture may be cut off."""
_MOST = 40
"""Looked at, the largest; chosen for time."""
_SIGMA_PX, _SIGMA_OF_SIZE = 0.05, 0.001
"""Error of a lamp's centre: and as a part of its diameter, for light is not the same on all of it; chosen above what
rendered lamps show."""
_BRIGHTER_HALF, _UNSURE = 0.5, 0.5
"""Share of the brightest above which the middle is looked for once more; and of the way from there, the error that a
lamp's centre has besides: light that is brighter on one side moves when more or less of it counts, as lamps that
flicker and glow in varnish do; chosen."""


def find_lamps(gray: Gray, smooth: Gray, places: Places) -> tuple[Found, Gray]:
    """Lamps in a picture (H, W) that is looked at, denoised() besides, and (H, W) 255 where anything is as bright."""
    limit, bright = as_bright(gray, smooth, places)
    if limit is None:
        return NONE, bright
    count, labels, stats, _ = cv2.connectedComponentsWithStats(bright, connectivity=8)
    x, y, wide, high, area = stats.T
    whole = (x >= _BORDER_PX) & (y >= _BORDER_PX)
    whole &= (x + wide <= places.width - _BORDER_PX) & (y + high <= places.height - _BORDER_PX)
    lamp = (area >= _LEAST_PX) & (area <= _MOST_SHARE * gray.size)
    lamp[0] = False  # what is not bright
    lamp &= np.bincount(labels[smooth >= limit], minlength=count) > 0
    ids = np.flatnonzero(lamp)
    found, ends = [], []
    for i in ids[np.argsort(-area[ids], kind="stable")[:_MOST]].tolist():
        rows, columns = slice(y[i], y[i] + high[i]), slice(x[i], x[i] + wide[i])
        weight = np.where(labels[rows, columns] == i, gray[rows, columns] - limit, 0.0)
        one = _centre(weight, rows, columns, places) if whole[i] else None
        if one is not None:
            found.append(one)
        ends.append(lamp_ends(weight, x[i], y[i], gray.shape, _BORDER_PX))
    if ends:
        found.append(places.found(np.concatenate(ends), END_SIGMA_PX, CORNER))
    return joined(found) if found else NONE, bright


def as_bright(gray: Gray, smooth: Gray, places: Places) -> tuple[float | None, Gray]:
    """Grey level from which a pixel is of a lamp, None without any, and (H, W) 255 where one is."""
    limit = _threshold(gray, smooth, places)
    if limit is None:
        return None, np.zeros_like(gray)
    return limit, np.asarray(cv2.threshold(gray, limit, 255, cv2.THRESH_BINARY)[1], np.uint8)


def _threshold(gray: Gray, smooth: Gray, places: Places) -> float | None:
    """Grey level from which a pixel is of a lamp; None where nothing is much brighter than the ceiling."""
    known = places.known[::_STRIDE, ::_STRIDE] > 0
    some, without_noise = (picture[::_STRIDE, ::_STRIDE][known] for picture in (gray, smooth))
    if not len(some):
        return None
    ceiling, lamp = np.quantile(some, [0.5, _BRIGHTEST]).tolist()
    if lamp - ceiling < _BRIGHTER or np.quantile(without_noise, _BRIGHTEST) - ceiling < _NOT_NOISE * _BRIGHTER:
        return None
    return float(ceiling + _HALF * (lamp - ceiling))


def _middle(weight: Array) -> Array:
    """(2,) px of the middle of light (h, w) in a window."""
    total = np.sum(weight)
    row, column = np.arange(weight.shape[0]), np.arange(weight.shape[1])
    return np.array([np.sum(weight, axis=0) @ column, np.sum(weight, axis=1) @ row]) / total


def _centre(weight: Array, rows: slice, columns: slice, places: Places) -> Found | None:
    """The centre of the light (h, w) on the ceiling, where none of it comes from beyond the view."""
    uv, stretch = places.window(rows, columns)
    on = weight > 0.0
    if np.any(~np.isfinite(stretch[on])) or not np.any(on):
        return None
    mass = weight[on] * stretch[on]
    total = float(np.sum(mass))
    centre = mass @ uv[on] / total
    middle, brighter = _middle(weight), _middle(np.maximum(weight - _BRIGHTER_HALF * np.max(weight), 0.0))
    diameter = 2.0 * np.sqrt(np.count_nonzero(on) / np.pi)
    sigma_px = math.hypot(_SIGMA_PX, _SIGMA_OF_SIZE * diameter, _UNSURE * math.hypot(*(brighter - middle)))
    at = places.found(middle[None] + [columns.start, rows.start], sigma_px, LAMP)
    return replace(at, uv=centre[None]) if len(at) else None
