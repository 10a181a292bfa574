"""Fields: crossings so near to each other that one passes for the next, as of grilles and open cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import LINE_CROSSINGS
from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.crossings import squares_with
from ceilvo.types import Crossings, Ints

_NEAR_M = 0.11
"""How near a neighbour is: over two cells of 50 mm, under a quarter of a tile's side; chosen."""
_NEIGHBOURS = 3
"""With more of them a crossing is in a dense field; chosen: a lamp's corner with its frame and joints has three."""
_MANY = 20
"""Crossings in dense fields from which they are left out; chosen: 9 s of the bench's tiled ceiling, with slatted vents,
have 10 at most, a ceiling of grilles 50 in the median and 164 at most."""
_AROUND_M = 0.25
"""So near to a field that is all of the ceiling, a crossing is of it too, and alone because the view ends; chosen: two
rows of cells."""
_SQUARES = 15
"""Squares with crossings that must remain; chosen: from 10 on no points are needed."""
ALL_CELLS = 250
"""Crossings in dense fields that are left out whatever remains, for the ceiling is all cells then; chosen: more than of
a ceiling of grilles. Motions are found by them, but places are not: a map would hold a hundred a square metre."""


def thinned(crossings: Crossings, focal_px: float) -> Crossings:
    """Points, and the crossings outside dense fields, where there are enough of them; else all.

    Whole fields are left out, not some of their crossings: which of them remain would change from frame to frame.
    """
    line = crossings.crossing_type < LINE_CROSSINGS
    xy = crossings.xy_base_m[line].astype(np.float32)
    alone = kernel.crowd(xy, _NEAR_M) <= _NEIGHBOURS
    dense = len(alone) - np.count_nonzero(alone)
    if dense < _MANY:
        return crossings
    if dense >= ALL_CELLS:
        alone[alone] = _dense_around(xy, alone) == 0
    stays = ~line
    stays[line] = alone
    others = crossings.of(stays)
    return others if dense >= ALL_CELLS or squares_with(others, focal_px) >= _SQUARES else crossings


def _dense_around(xy: NDArray[np.float32], alone: NDArray[np.bool_]) -> Ints:
    """(M,) for those of (N, 2) that are alone, how many that are not lie around."""
    return np.asarray(kernel.crowd(xy, _AROUND_M)[alone] - kernel.crowd(xy[alone], _AROUND_M))
