"""Grilles: fields of crossings so near to each other that one passes for the next, and that all say the same."""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.crossings import squares_with
from ceilvo.types import Crossings

_NEAR_M = 0.11
"""How near a neighbour is: over two cells of 50 mm, under a quarter of a tile's side; chosen."""
_NEIGHBOURS = 3
"""With more of them a crossing is in a dense field; chosen: a lamp's corner with its frame and joints has three."""
_MANY = 20
"""Crossings in dense fields from which they are left out; chosen: 9 s of the bench's tiled ceiling, with slatted vents,
have 10 at most, a ceiling of grilles 50 in the median and 164 at most."""
_SQUARES = 15
"""Squares with crossings that must remain; chosen: from 10 on no points are needed."""


def thinned(crossings: Crossings, focal_px: float) -> Crossings:
    """The crossings outside dense fields, where there are enough of them; else all.

    Whole fields are left out, not some of their crossings: which of them remain would change from frame to frame.
    """
    xy = crossings.xy_base_m.astype(np.float32)
    alone = kernel.crowd(xy, _NEAR_M) <= _NEIGHBOURS
    if len(alone) - np.count_nonzero(alone) < _MANY:
        return crossings
    others = crossings.of(alone)
    return others if squares_with(others, focal_px) >= _SQUARES else crossings
