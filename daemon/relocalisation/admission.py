"""What of a view may teach the filter: a wrong place must not be learnt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.se2 import transform
from ceilvo.types import Array, Observations, Pose

HALF = 0.5
"""A view of which the map explains less teaches nothing."""
FEWEST_KNOWN = 10
"""Features on known ground that it takes to say so; chosen."""
CONVINCING = 0.85
"""While the place is in doubt a view corrects the pose where so much of it is explained; chosen."""


def of_sure_place(view: Observations, pose: Array, coverage: Coverage) -> Observations | None:
    """A view from a pose (3,) that is sure: all of it, or None where the map knows the ground but not what is there."""
    known = coverage.knows(transform(Pose(pose), view.xy_base_m))
    count = int(np.count_nonzero(known))
    strange = count >= FEWEST_KNOWN and np.count_nonzero((view.label >= 0) & known) < HALF * count
    return None if strange else view


def of_doubtful_place(view: Observations, pose: Array, coverage: Coverage, submap: bool) -> Observations | None:
    """A view from a pose (3,) that is in doubt: what is matched where nearly all is, and what nobody has mapped.

    What is missing here may be there, so nothing of it is told.

    Args:
        submap: what is learnt goes into a map of its own.
    """
    matched = view.label >= 0
    if np.count_nonzero(matched) >= CONVINCING * len(view):
        return replace(view.of(matched), visible_m=np.empty((0, 2)))
    known = coverage.knows(transform(Pose(pose), view.xy_base_m))
    if not submap or np.count_nonzero(known) >= FEWEST_KNOWN:
        return None
    return replace(view.of(~known), visible_m=np.empty((0, 2)))
