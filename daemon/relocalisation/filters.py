"""The filter that the settings name."""

from __future__ import annotations

import numpy as np

from ceilvo.config import Filter
from ceilvo.daemon.slam.paper.fastslam import FastSlam
from ceilvo.daemon.slam.paper.ukf import Ukf
from ceilvo.daemon.slam.pfcf import Pfcf
from ceilvo.daemon.slam.pose_filter import PoseFilter


def make_filter(settings: Filter, rng: np.random.Generator) -> PoseFilter:
    """filter.method: pfcf, pfcf_paper, pf or ukf."""
    if settings.method == "ukf":
        return Ukf(settings, rng)
    if settings.method == "pfcf":
        return Pfcf(settings, rng)
    return FastSlam(settings, rng)
