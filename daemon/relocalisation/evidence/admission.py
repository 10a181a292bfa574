"""What of a view may teach the filter: a wrong place must not be learnt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.daemon.relocalisation.evidence.type_raster import REACH_M
from ceilvo.daemon.slam.association import Near
from ceilvo.se2 import transform
from ceilvo.types import Array, Observations, Pose

HALF = 0.5
"""A view of which the map explains less teaches nothing."""
FEWEST_KNOWN = 10
"""Features on known ground that it takes to say so; chosen."""
CONVINCING = 0.85
"""While the place is in doubt a view corrects the pose where so much of it is explained; chosen."""

FARTHEST_M = 1.0
"""No feature is matched with a landmark further off: the largest filter.association_gate_m."""


def of_sure_place(view: Observations, pose: Array, coverage: Coverage) -> Observations | None:
    """A view from a pose (3,) that is sure: all of it, or None where the map knows the ground but not what is there."""
    known = coverage.knows(transform(Pose(pose), view.xy_base_m))
    count = int(np.count_nonzero(known))
    strange = count >= FEWEST_KNOWN and np.count_nonzero((view.label >= 0) & known) < HALF * count
    return None if strange else view


def of_doubtful_place(
    view: Observations, pose: Array, coverage: Coverage, submap: bool, near: Near | None = None
) -> Observations | None:
    """A view from a pose (3,) that is in doubt: what is matched where nearly all is, and what nobody has mapped.

    What is missing here may be there, so nothing of it is told.

    Args:
        submap: what is learnt goes into a map of its own.
        near: of the map, where another place is likelier: all places move with this one, so what would put it right
            and them wrong is not told.
    """
    matched = view.label >= 0
    convincing = np.count_nonzero(matched) >= CONVINCING * len(view)
    if convincing and (near is None or _lies_there(view.of(matched), pose, near)):
        return replace(view.of(matched), visible_m=np.empty((0, 2)))
    known = coverage.knows(transform(Pose(pose), view.xy_base_m))
    if not submap or np.count_nonzero(known) >= FEWEST_KNOWN:
        return None
    return replace(view.of(~known), visible_m=np.empty((0, 2)))


def _lies_there(view: Observations, pose: Array, near: Near) -> bool:
    """Whether labelled features, seen from a pose (3,), are where their landmarks are."""
    at = transform(Pose(pose), view.xy_base_m)
    labels, landmarks = near(at, FARTHEST_M)
    off = landmarks.xy_map_m[np.searchsorted(labels, view.label)] - at
    return bool(np.hypot(*np.median(off, axis=0)) <= REACH_M)
