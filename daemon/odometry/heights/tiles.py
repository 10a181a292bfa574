"""How high a ceiling is, from tiles whose size is known: the further away, the closer together their joints seem."""

from __future__ import annotations

import numpy as np

from ceilvo.types import Array, Ints

_REACH, _STEPS = 0.14, 141
"""Heights that are tried, as a part of the expected one, and how many; chosen: of four tiles in a row, with one more
or less a fifth would be missed."""
_FEWEST = 4
"""Joints of one direction, and in which so many must stand at whole tiles from each other; chosen."""
_FITS = 0.8
"""Length of the mean of the joints' phases as unit vectors, from which on they stand at whole tiles; chosen."""
_OFF_M = 0.008
"""A joint stands at most so far from its place; chosen: as wide as a joint."""


def seen_high(apparent_m: Array, weight: Array, tile_m: float, expected: float) -> tuple[float, int] | None:
    """The true height over the assumed one, and the joints that say so; None where they do not stand at whole tiles.

    Args:
        apparent_m: (L,) where joints of one direction seem to be across it, were they at the assumed height.
        weight: (L,) crossings of each; a vent's have few.
        expected: about the ratio that is sought.
    """
    if len(apparent_m) < _FEWEST:
        return None
    order = np.argsort(apparent_m)
    at, weight = apparent_m[order], weight[order] ** 2 / np.sum(weight**2)
    tried = expected * np.linspace(1.0 - _REACH, 1.0 + _REACH, _STEPS)
    phase = np.exp(2j * np.pi / tile_m * tried[:, None] * at) @ weight
    fits = np.abs(phase)
    best = int(np.argmax(fits))
    if fits[best] < _FITS or best in (0, _STEPS - 1):
        return None
    ratio, start = float(tried[best]), float(np.angle(phase[best])) * tile_m / (2.0 * np.pi)
    for _ in range(3):
        number: Ints = np.rint((ratio * at - start) / tile_m).astype(np.int64)
        good = np.abs(ratio * at - start - tile_m * number) < _OFF_M
        if np.count_nonzero(good) < _FEWEST or np.ptp(number[good]) < _FEWEST - 1:
            return None
        spacing, first = np.polyfit(number[good], at[good], 1)
        ratio = tile_m / float(spacing)
        start = ratio * float(first)
    return ratio, int(np.count_nonzero(good))
