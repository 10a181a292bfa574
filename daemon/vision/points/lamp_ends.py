"""Ends of long lamps: where their light ends, also of those that are in view in part."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ceilvo.types import Array

_LONG = 3.0
"""Length over width from which a lamp has ends; chosen: a square one's diagonal is none, panels of two tiles have
corners."""
_NARROWEST_PX = 8.0
"""Width of a lamp that has ends; chosen: half of the recorded lamps' blobs (frames 0 to 49) are below 5 px wide, and
their ends move by pixels from frame to frame."""
_SHORTEST, _LONGEST, _TIP = 2.5, 4.0, 1.0
"""Where the light of a lamp is taken to be as inside, in widths before its end: from, at least and at most, to; chosen:
a blurred end is shorter, and beyond four a lens bends the lamp."""
_EVEN = 0.1
"""By which the inner half of that may be brighter or darker than the outer one; chosen: 99 of 100 rendered strip lamps
are within 0.043 (484 of `strips-only`, seed 150). Light that tapers ends wherever the threshold is."""
_UNIFORM = 12.0
"""A uniform bar's squared length over the variance of its light."""
SIGMA_PX = 1.0
"""Error of an end; chosen above the 0.65 px within which 95 of 100 ends of `strips-only` (484, seed 150) lie of their
median."""


@dataclass(frozen=True, slots=True)
class _Axis:
    """Of a blob's light: its middle (2,), the unit vector (2,) along it, its width and length, px."""

    middle: Array
    along: Array
    width: float
    length: float


def lamp_ends(weight: Array, left: int, top: int, shape: tuple[int, ...], border_px: int) -> Array:
    """(N, 2) px where a long lamp ends, none for others; an end at the side of the picture is none.

    Args:
        weight: (h, w) light of the lamp, 0 beside it; left, top: of the window in the picture of that shape.
        border_px: light that is nearer to the picture's side may go on beyond it.
    """
    axis = _axis(weight, left, top)
    if axis is None:
        return np.zeros((0, 2))
    row, column = np.nonzero(weight > 0.0)
    at, light = np.column_stack([column + left, row + top]).astype(np.float64), weight[row, column]
    far = np.array(shape[1::-1]) - 1 - border_px
    inside = np.all((at >= border_px) & (at <= far), axis=1)
    ends = [_end(at, light, inside, axis, sign) for sign in (1.0, -1.0)]
    return np.array([end for end in ends if end is not None]).reshape(-1, 2)


def _axis(weight: Array, left: int, top: int) -> _Axis | None:
    """The axis of light (h, w) in a window; None where it is not long."""
    m = cv2.moments(weight)
    if m["m00"] <= 0.0:
        return None
    variance, axes = np.linalg.eigh(np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / m["m00"])
    width, length = np.sqrt(_UNIFORM * np.maximum(variance, 0.0)).tolist()
    if width < _NARROWEST_PX or length < _LONG * width:
        return None
    return _Axis(np.array([left + m["m10"] / m["m00"], top + m["m01"] / m["m00"]]), axes[:, 1], width, length)


def _end(at: Array, light: Array, inside: Array, axis: _Axis, sign: float) -> Array | None:
    """(2,) px of the end on that side; None where the picture ends first, or the light is not even.

    Light beyond the body is worth a length, by what the body has per pixel and how that fades towards the end: as exact
    as the sum of many pixels.
    """
    along = sign * axis.along
    across = np.array([-along[1], along[0]])
    t, s = (at - axis.middle) @ along, (at - axis.middle) @ across
    last = float(np.max(t))
    if not np.all(inside[t > last - axis.width]):
        return None
    body = float(np.clip(axis.length / axis.width - 1.0, _SHORTEST, _LONGEST))
    first, half, tip = (last - k * axis.width for k in (body, 0.5 * (body + _TIP), _TIP))
    from_first, from_half, beyond = (float(light @ np.clip(t - begin + 0.5, 0.0, 1.0)) for begin in (first, half, tip))
    inner, outer = (from_first - from_half) / (half - first), (from_half - beyond) / (tip - half)
    if abs(inner - outer) >= _EVEN * outer:
        return None
    fades = (outer - inner) / (tip - half)
    at_tip = outer + 0.5 * fades * (tip - half)
    length = 2.0 * beyond / (at_tip + np.sqrt(max(at_tip**2 + 2.0 * fades * beyond, 0.0)))
    end, near = tip + length, t > first
    model = np.column_stack([np.ones(np.count_nonzero(near)), t[near] - end])
    offset, *_ = np.linalg.lstsq(model * light[near, None] ** 0.5, s[near] * light[near] ** 0.5, rcond=None)
    return np.asarray(axis.middle + end * along + offset[0] * across)
