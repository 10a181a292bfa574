"""The filter that the settings name."""

from __future__ import annotations

import numpy as np

from ceilvo.config import Filter
from ceilvo.config.schema import OLD_METHODS
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.joint_rule import JointRule
from ceilvo.daemon.slam.pose_filter import PoseFilter


def make_filter(settings: Filter, rng: np.random.Generator) -> PoseFilter:
    """filter.method: joint, pfcf_paper, pf or ukf; joint also by its old name."""
    method = OLD_METHODS.get(settings.method, settings.method)
    if method == "ukf":
        from ceilvo.daemon.slam.paper.ukf import UkfRule  # a robot starts sooner without

        return JointFilter(settings, rng, UkfRule(settings))
    if method == "joint":
        return JointFilter(settings, rng, JointRule(settings))
    from ceilvo.daemon.slam.paper.fastslam import FastSlam

    return FastSlam(settings, rng)
