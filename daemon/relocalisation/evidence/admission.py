"""What of a view may teach the filter: a wrong place must not be learnt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceilvo.daemon.odometry.matching import Near
from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.daemon.relocalisation.evidence.type_raster import REACH_M
from ceilvo.se2 import transform
from ceilvo.types import NO_LANDMARK, Array, Observations, Pose

HALF = 0.5
"""A view of which the map explains less teaches nothing."""
FEWEST_KNOWN = 10
"""Features on known ground that it takes to say so; chosen."""
CONVINCING = 0.85
"""While the place is in doubt a view corrects the pose where so much of it is explained; chosen."""

FARTHEST_M = 1.0
"""No feature is matched with a landmark further off: the largest filter.association_gate_m."""


def of_sure_place(view: Observations, pose: Array, coverage: Coverage, near: Near | None = None) -> Observations | None:
    """A view from a pose (3,) that is sure: all of it, or None where the map knows the ground but not what is there.

    Where half of it lies on its landmarks and a part does not, that part is of others: tiles that were hung anew
    took the pose along, by a part of a tile.

    Args:
        near: of the map; None: whatever is labelled is matched.
    """
    known = coverage.knows(transform(Pose(pose), view.xy_base_m), view.crossing_type)
    count = int(np.count_nonzero(known))
    matched = view.label >= 0
    if near is not None and np.any(matched):
        fits = np.hypot(*_residuals(view.of(matched), pose, near).T) <= REACH_M
        if HALF <= np.mean(fits) < CONVINCING:
            matched[matched] = fits
            view = replace(view, label=np.where(matched, view.label, NO_LANDMARK))
    strange = count >= FEWEST_KNOWN and np.count_nonzero(matched & known) < HALF * count
    return None if strange else view


def of_doubtful_place(
    view: Observations, pose: Array, coverage: Coverage, submap: bool, near: Near | None = None, led: bool = False
) -> Observations | None:
    """A view from a pose (3,) that is in doubt: what is matched where nearly all is, and what nobody has mapped.

    What is missing here may be there, so nothing of it is told.

    Args:
        submap: what is learnt goes into a map of its own.
        near: of the map: a feature that lies further off than a place is known is another one, as of tiles that were
            hung anew; None: whatever is labelled is matched.
        led: another place is likelier: all places move with this one, so what would put it right and them wrong is not
            told.
    """
    matched = view.label >= 0
    if near is not None and np.any(matched):
        off = _residuals(view.of(matched), pose, near)
        led = led and bool(np.hypot(*np.median(off, axis=0)) > REACH_M)
        matched[matched] = np.hypot(*off.T) <= REACH_M
    convincing = np.count_nonzero(matched) >= CONVINCING * len(view)
    if convincing and not led:
        return replace(view.of(matched), visible_m=np.empty((0, 2)))
    known = coverage.knows(transform(Pose(pose), view.xy_base_m), view.crossing_type)
    if not submap or np.count_nonzero(known) >= FEWEST_KNOWN:
        return None
    return replace(view.of(~known), visible_m=np.empty((0, 2)))


def _residuals(view: Observations, pose: Array, near: Near) -> Array:
    """(K, 2) of labelled features, seen from a pose (3,), to their landmarks."""
    at = transform(Pose(pose), view.xy_base_m)
    labels, landmarks = near(at, FARTHEST_M)
    return np.asarray(landmarks.xy_map_m[np.searchsorted(labels, view.label)] - at)
