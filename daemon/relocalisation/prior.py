"""How likely places that a view was found at were before it."""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.relocalisation.lattice import offset, rival_poses
from ceilvo.types import Array

ENTERS = 0.05
"""Chance per spot that a robot comes from ground that nobody has mapped to ground that somebody has; chosen."""
PLACES_PER_M2 = 4.0 / 0.6**2
"""Places of a map that a view may be from: four headings on every tile of 0.6 m."""
LED = 0.95
"""Of the robots that may have changed floors, how many come out where a transition leads to; chosen."""
LED_M, LED_RAD = 1.0, 0.5
"""Around there: where a robot stands in a cabin, and how it stands, is not known better; chosen."""


def log_odds_of_found(poses: Array, pose: Array, leads: Array, area_m2: float, spots: int) -> Array:
    """(N,) of places that a view was found at, against all places that are not listed.

    Args:
        poses: (N, 3); pose: (3,) tracked.
        leads: (K, 3) transforms from the tracked pose to where transitions lead to.
        area_m2: of the map.
        spots: looked at since the doubt; a place that was there before would have been listed then.
    """
    out = np.full(len(poses), -np.log(max(area_m2, 1.0) * PLACES_PER_M2))
    out += np.log(ENTERS) if spots > 0 else 0.0
    if not len(leads):
        return out
    out += np.log1p(-LED)
    for there in rival_poses(leads, pose):
        off = offset(poses, there)
        led = (np.hypot(off[:, 0], off[:, 1]) < LED_M) & (np.abs(off[:, 2]) < LED_RAD)
        out[led] = np.log(LED / (len(leads) * max(int(np.count_nonzero(led)), 1)))
    return out
