"""Beliefs over places that views are weighed into, one spot after the other."""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.relocalisation.place_belief import PlaceBelief
from ceilvo.types import Array

STEP_M = 0.26
"""From spot to spot."""


def alike(log_ratio: Array) -> Array:
    """(P, 2) the same against either kind of wrong place."""
    return np.column_stack([log_ratio, log_ratio])


def spot(belief: PlaceBelief, ratio: list[float], views: int = 1, way_m: float = STEP_M) -> None:
    belief.moved(way_m, 1.0)
    belief.leave_spot()
    for _ in range(views):
        belief.weigh(alike(np.array(ratio[: len(belief)])))
