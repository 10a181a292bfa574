"""Fields: crossings so near to each other that one passes for the next, as of grilles and open cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import LINE_CROSSINGS
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
_AROUND_M = 0.25
"""So near to a field that is all of the ceiling, a crossing is of it too, and alone because the view ends; chosen: two
rows of cells."""
_SQUARES = 15
"""Squares with crossings that must remain; chosen: from 10 on no points are needed."""
ENOUGH = 10
"""Squares with features at which no points are looked for; chosen, as for faint lines: tiles show 30."""
ALL_CELLS = 250
"""Crossings in dense fields from which a ceiling may be all cells; chosen: more than most views of grilles have."""
_CELLS_ALONE = 0.165
"""Of all crossings, where fewer are outside dense fields a ceiling is all cells; measured: 0.10 to 0.14 under open
cells, where the view ends and beside lamps, 0.19 and more under grilles, of which one view had 336 in dense fields."""


def thinned(crossings: Crossings, focal_px: float) -> Crossings:
    """The crossings outside dense fields, where there are enough of them; else all, and of a ceiling that is all cells.

    Whole fields are left out, not some of their crossings: which of them remain would change from frame to frame.
    """
    xy = crossings.xy_base_m.astype(np.float32)
    alone = _alone(xy)
    if np.count_nonzero(~alone) < _MANY or _all_cells(alone):
        return crossings
    others = crossings.of(alone)
    return others if squares_with(others, focal_px) >= _SQUARES else crossings


def without_cells(crossings: Crossings) -> Crossings:
    """What tells places: of a ceiling that is all cells, points and what lies apart; of any other all.

    Motions are found by cells, but places are not: a map would hold a hundred a square metre, all alike.
    """
    if len(crossings) < ALL_CELLS:
        return crossings
    line = crossings.crossing_type < LINE_CROSSINGS
    xy = crossings.xy_base_m[line].astype(np.float32)
    alone = _alone(xy)
    if not _all_cells(alone):
        return crossings
    alone[alone] = kernel.crowd(xy, _AROUND_M)[alone] == kernel.crowd(xy[alone], _AROUND_M)  # none in the field
    stays = ~line
    stays[line] = alone
    return crossings.of(stays)


def for_places(crossings: Crossings, focal_px: float) -> Crossings:
    """What tells places: without_cells(), and no points where lines suffice.

    There points are looked for so that motion goes on when lines become few. A map would have them from some views
    and not from others.
    """
    crossings = without_cells(crossings)
    line = crossings.crossing_type < LINE_CROSSINGS
    if np.all(line):
        return crossings
    lines = crossings.of(line)
    return lines if squares_with(lines, focal_px) >= ENOUGH else crossings


def _all_cells(alone: NDArray[np.bool_]) -> bool:
    """Whether a ceiling is nothing but one dense field, of the crossings (M,) that are in none."""
    outside = int(np.count_nonzero(alone))
    return len(alone) - outside >= ALL_CELLS and outside < _CELLS_ALONE * len(alone)


def _alone(xy: NDArray[np.float32]) -> NDArray[np.bool_]:
    """(M,) which of (M, 2) are in no dense field."""
    return np.asarray(kernel.crowd(xy, _NEAR_M) <= _NEIGHBOURS)
