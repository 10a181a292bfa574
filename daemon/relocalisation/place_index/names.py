"""Which landmarks are mistaken names of others.

A lamp's edge that crosses a joint, or lies near one, is called by another type now and then, and where a robot often
drives the map has the same corner by several names. Else places that were often visited would match better than those
that were not.
"""

from __future__ import annotations

import numpy as np

from ceilvo.crossing_types import JOINTS
from ceilvo.daemon.relocalisation.place_index.blocks import FINE_M, LandmarkBlocks
from ceilvo.daemon.relocalisation.place_index.id_table import Slots

SAME_M = 0.05
"""Two landmarks of different types so near each other, neither a crossing of joints, are one; chosen: ten sigmas."""
SEEN_255 = 12
"""A change of visibility by so much, 5 %, is taken in; chosen for time. Names are compared in steps of it."""


def name_again(blocks: LandmarkBlocks, slots: Slots) -> None:
    """Of landmarks that are new or were seen more or less often, and those beside them, the most visible is named; of
    several that are about as visible the oldest."""
    if len(slots):
        _name(blocks, np.union1d(slots, same_corner(blocks, slots)).astype(np.int32))


def same_corner(blocks: LandmarkBlocks, slots: Slots) -> Slots:
    """Slots of landmarks that may be the same as others."""
    return np.unique(_pairs(blocks, slots)[1])


def _name(blocks: LandmarkBlocks, slots: Slots) -> None:
    which, other = _pairs(blocks, slots)
    mine = slots[which]
    seen, more = (blocks.visibility[at] // (SEEN_255 + 1) for at in (mine, other))
    beaten = (more > seen) | ((more == seen) & (blocks.ids[other] < blocks.ids[mine]))
    blocks.named[slots] = np.bincount(which[beaten], minlength=len(slots)) == 0


def _pairs(blocks: LandmarkBlocks, slots: Slots) -> tuple[Slots, Slots]:
    """Index of one of the slots, and the slot of a landmark that may be the same."""
    reach = round(SAME_M / FINE_M)
    which, other = blocks.pairs(blocks.xy[slots], reach)
    mine = slots[which]
    kind, kinds = blocks.crossing_type[mine], blocks.crossing_type[other]
    off = (blocks.xy[mine] - blocks.xy[other]).astype(np.float64)
    same = (kind != kinds) & (kind != JOINTS) & (kinds != JOINTS) & (np.hypot(*off.T) <= reach)
    return which[same].astype(np.int32), other[same]
