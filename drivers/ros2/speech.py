"""What the node says of an estimate, wherever it is said: transforms, pose, odometry, health."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.config import Ros2
from ceilvo.drivers.ros2.conversion import UNUSABLE, Conversion
from ceilvo.drivers.ros2.endpoints import Endpoint, Endpoints
from ceilvo.types import Estimate, State

Array = NDArray[np.float64]
Said = tuple[Endpoint, Any, int]
"""Where, a message, and its time in ns since 1970."""


class Speech:
    """Of one run, its estimates in their order."""

    def __init__(self, config: Ros2, conversion: Conversion, endpoints: Endpoints) -> None:
        self._config, self._conversion, self._endpoints = config, conversion, endpoints
        self._drift = _Drift()
        self._last: Estimate | None = None

    def motion(self, estimate: Estimate, at_ns: int) -> Iterator[Said]:
        """Of an estimate that is finite."""
        before, self._last = self._last, estimate
        self._drift.advance(estimate, before)
        make, ends = self._conversion, self._endpoints
        moved = [] if estimate.state in UNUSABLE else [make.map_from_odom(estimate, at_ns)]
        if self._config.fleet_tf and moved:
            whole = make.tf(*moved, make.odom_from_base(estimate, at_ns, self._config.fleet_frame))
            yield ends.fleet, whole, at_ns
        if self._config.odom_to_base:
            moved.append(make.odom_from_base(estimate, at_ns, self._config.base_frame))
        if moved:
            yield ends.tf, make.tf(*moved), at_ns
        yield ends.pose, make.pose(estimate, at_ns), at_ns
        yield ends.odom, make.odometry(estimate, at_ns, self._drift.cov, self._drift.twist_cov), at_ns

    def health(self, at_ns: int, state: State, counters: Mapping[str, object]) -> Said:
        made = self._conversion.diagnostics(at_ns, state, self._last, counters)
        return self._endpoints.diagnostics, made, at_ns


class _Drift:
    """Covariance of odom -> base since the start, summed over the steps, and of the twist."""

    def __init__(self) -> None:
        self.cov = np.zeros((3, 3))
        self.twist_cov = np.full((3, 3), np.nan)

    def advance(self, estimate: Estimate, before: Estimate | None) -> None:
        step = estimate.motion
        if before is None or not np.isfinite(step.cov).all():
            return
        dt_s = 1e-9 * (estimate.stamp_ns - before.stamp_ns)
        if dt_s <= 0.0:
            return
        self.twist_cov = step.cov / dt_s**2
        self.cov = self._along(se2.between(before.odom, estimate.odom), float(before.odom[2])) + self._turned(
            step.cov, float(before.odom[2])
        )

    def _along(self, moved: Array, heading_rad: float) -> Array:
        """What the heading's uncertainty makes of a step."""
        x, y = se2.rotation(heading_rad) @ moved[:2]
        j = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
        return np.asarray(j @ self.cov @ j.T, np.float64)

    @staticmethod
    def _turned(cov: Array, heading_rad: float) -> Array:
        r = np.eye(3)
        r[:2, :2] = se2.rotation(heading_rad)
        return np.asarray(r @ cov @ r.T, np.float64)
