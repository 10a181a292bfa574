"""The filter that the settings name."""

from __future__ import annotations

import numpy as np

from ceilvo.config import Filter
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.paper.fastslam import FastSlam
from ceilvo.daemon.slam.paper.ukf import UkfRule
from ceilvo.daemon.slam.pfcf import PfcfRule
from ceilvo.daemon.slam.pose_filter import PoseFilter


def make_filter(settings: Filter, rng: np.random.Generator) -> PoseFilter:
    """filter.method: pfcf, pfcf_paper, pf or ukf."""
    if settings.method == "ukf":
        return JointFilter(settings, rng, UkfRule(settings))
    if settings.method == "pfcf":
        return JointFilter(settings, rng, PfcfRule(settings))
    return FastSlam(settings, rng)
