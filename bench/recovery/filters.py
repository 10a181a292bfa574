"""The filters of the experiments: the daemon's, the default one with a recovery of its own."""

from __future__ import annotations

import numpy as np

from ceilvo.bench.recovery.recovering_filter import RecoveringFilter
from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.pose_filter import PoseFilter


def make_recovering_filter(settings: Filter, rng: np.random.Generator) -> PoseFilter:
    """filter.method as the daemon makes it; the default one also finds itself again when it is lost on the map."""
    made = make_filter(settings, rng)
    return RecoveringFilter(made) if settings.method == "joint" and isinstance(made, JointFilter) else made
