"""Ranges of the last stretch of the way, and what they say together of where that way lies in the map.

The shape of the way is odometry's. An anchor's error has a part that stays the same over the stretch: what is left of
offset and scale, or something that stands in the path. So each anchor has one bias there, of its own, and the noise of
single ranges is beside that. Without it fifty ranges from one spot would count as fifty.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ceilvo.daemon.relocalisation.beacons.anchors import AnchorTable
from ceilvo.daemon.relocalisation.beacons.range_errors import MOVED, direct_share, log_density
from ceilvo.se2 import inverse, rotation, transform
from ceilvo.types import Array, Ints, Pose

MOST = 160
"""Ranges kept; chosen for time: of three anchors the last five seconds at 10 Hz."""
WAY_M = 6.0
"""And of no longer a way: odometry's errors are then below a range's; chosen."""
WORK = 60_000
"""Ranges times poses that are weighed at once, for time: beyond it fewer ranges are, spread over the stretch."""
_ROUNDS = 3
"""Of reweighting for an anchor's bias."""


@dataclass(slots=True)
class RangeWindow:
    """N ranges.

    Attributes:
        tag_odom_m: (N, 2) where the tag was in odom.
        anchor: (N,) row of the anchor's table; range_m: (N,) as it was said.
    """

    tag_odom_m: Array = field(default_factory=lambda: np.empty((0, 2)))
    anchor: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    range_m: Array = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.range_m)

    @property
    def anchors(self) -> Ints:
        """Rows of the anchors that were heard."""
        return np.unique(self.anchor)

    def add(self, tag_odom_m: Array, anchor: Ints, range_m: Array) -> None:
        """Ranges (N,), the tag at (N, 2); the oldest go."""
        at = np.concatenate([self.tag_odom_m, tag_odom_m])
        keep = np.hypot(*(at - at[-1]).T) < WAY_M
        keep[: max(0, len(at) - MOST)] = False
        self.tag_odom_m = at[keep]
        self.anchor = np.concatenate([self.anchor, anchor])[keep]
        self.range_m = np.concatenate([self.range_m, range_m])[keep]

    def clear(self) -> None:
        self.tag_odom_m, self.anchor = np.empty((0, 2)), np.empty(0, np.int64)
        self.range_m = np.empty(0)

    def log_likelihood(self, table: AnchorTable, tag_z_m: float, odom: Array, poses: Array) -> Array:
        """(P,) of the base being at poses (P, 3) in map now that it is at (3,) in odom."""
        if not len(self) or not len(poses):
            return np.zeros(len(poses))
        step = max(1, -(-len(self) * len(poses) // WORK))
        some = np.arange(len(self) - 1, -1, -step)[::-1]
        in_base = transform(Pose(inverse(odom)), self.tag_odom_m[some])
        c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x = poses[:, :1] + c * in_base[:, 0] - s * in_base[:, 1]
        y = poses[:, 1:2] + s * in_base[:, 0] + c * in_base[:, 1]
        which = self.anchor[some]
        distance, _ = table.distances(which, np.stack([x, y], axis=-1), tag_z_m)
        error = self.range_m[some] - table.expected(which, distance)
        sigma = table.bias_sigma(which, distance)
        out = np.zeros(len(poses))
        for a in np.unique(which).tolist():
            own = which == a
            out += _with_bias(error[:, own], table.noise_m, np.mean(sigma[:, own], axis=1))
        return out

    def bound(self, table: AnchorTable, margin_m: float) -> tuple[Array, Array]:
        """Corners (2,) of a box in map that the tag must be in: paths may be longer than the distance, not shorter."""
        low, high = np.full(2, -np.inf), np.full(2, np.inf)
        for a in self.anchors.tolist():
            reach = float(np.median(self.range_m[self.anchor == a])) + margin_m
            low, high = np.maximum(low, table.xyz_m[a, :2] - reach), np.minimum(high, table.xyz_m[a, :2] + reach)
        return low, np.maximum(high, low)


def _with_bias(error_m: Array, noise_m: float, sigma_m: Array) -> Array:
    """(P,) log-likelihood of errors (P, N) of one anchor that share a bias of standard deviation (P,), or more where
    something stands in the path; by Laplace's method around the likeliest bias."""
    rest = np.hypot(noise_m, sigma_m)[:, None]
    bias, var = np.zeros((len(error_m), 1)), sigma_m[:, None] ** 2
    middle = np.median(error_m, axis=1, keepdims=True)
    # a path that is obstructed throughout has a bias that the offset's sigma does not know
    free = np.maximum(var, middle**2)
    for k in range(_ROUNDS):
        weight = direct_share(error_m - (middle if k == 0 else bias), rest if k == 0 else noise_m)
        precision = np.sum(weight, axis=1, keepdims=True) / noise_m**2
        bias = np.sum(weight * error_m, axis=1, keepdims=True) / noise_m**2 / (precision + 1.0 / free)
    own = np.sum(log_density(error_m - bias, noise_m), axis=1)
    prior = log_density(bias[:, 0], sigma_m, MOVED)
    width = 0.5 * np.log(2.0 * np.pi / (precision[:, 0] + 1.0 / free[:, 0]))
    return np.asarray(own + prior + width)


@dataclass(frozen=True, slots=True)
class Fix:
    """What ranges alone say.

    Attributes:
        pose: (3,) in map.
        cov: (2, 2) of its position.
        log_likelihood: there.
        reach_m: how far off the farthest place is that is nearly as likely.
    """

    pose: Array
    cov: Array
    log_likelihood: float
    reach_m: float = 0.0


MARGIN_M = 2.0
"""Around the box that ranges bound; chosen: an antenna's delay and noise."""
_MOST_CELLS = 900
"""Of the coarse search, for time."""
_STARTS = 12
"""Best cells that are refined."""
_STEPS_M = (1.0, 0.5, 0.25, 0.12)
"""Of the refinement."""
_SURER = 10.0
"""A place that is less likely by no more, as a logarithm, is nearly as likely; chosen: two obstructed paths cost it."""
_FINE, _SPREAD = 11, 2.0
"""Side of the grid that the covariance is measured on, and how many cells of it are a sigma at most."""


def find(window: RangeWindow, table: AnchorTable, tag_z_m: float, odom: Array, headings: Array) -> Fix | None:
    """Where the ranges say that the base is, at (3,) in odom; None where they bound no place.

    Args:
        headings: (H,) in map that the base may have now.
    """
    low, high = window.bound(table, MARGIN_M)
    if not np.all(np.isfinite(low + high)):
        return None
    cell = max(_STEPS_M[0], float(np.sqrt(np.prod(np.maximum(high - low, 1.0)) / _MOST_CELLS)))
    x, y = (np.arange(a, b + cell, cell) for a, b in zip(low.tolist(), high.tolist(), strict=True))
    poses = _grid(x, y, headings)

    def weigh(at: Array) -> Array:
        return window.log_likelihood(table, tag_z_m, odom, at)

    best = poses[np.argsort(-weigh(poses))[:_STARTS]]
    for step in (2.0 * cell / 3.0, *_STEPS_M):
        around = _grid(np.array([-step, 0.0, step]), np.array([-step, 0.0, step]), np.zeros(1))
        trial = (best[:, None] + around).reshape(-1, 3)
        value = weigh(trial).reshape(len(best), -1)
        best = trial.reshape(len(best), -1, 3)[np.arange(len(best)), np.argmax(value, axis=1)]
        top = np.max(value, axis=1)
    first = int(np.argmax(top))
    near = top > top[first] - _SURER
    fix = _measured(best[first], float(top[first]), weigh)
    return replace(fix, reach_m=float(np.max(np.hypot(*(best[near] - fix.pose)[:, :2].T))))


def _measured(pose: Array, top: float, weigh: Callable[[Array], Array]) -> Fix:
    """Mean and covariance of the position around the best pose, at its own heading."""
    step = _STEPS_M[-1]
    for _ in range(4):
        axis = np.asarray(step * (np.arange(_FINE) - _FINE // 2), np.float64)
        at = pose + _grid(axis, axis, np.zeros(1))
        weight = np.exp(weigh(at) - top)
        weight /= np.sum(weight)
        mean = weight @ at[:, :2]
        off = at[:, :2] - mean
        cov = np.asarray((off * weight[:, None]).T @ off)
        if np.sqrt(np.max(np.diagonal(cov))) < _SPREAD * step:
            break
        step *= 2.0
    return Fix(np.array([*mean, pose[2]]), cov + (0.3 * step) ** 2 * np.eye(2), top)


def _grid(x: Array, y: Array, theta: Array) -> Array:
    """(N, 3) all combinations."""
    return np.stack(np.meshgrid(x, y, theta, indexing="ij"), axis=-1).reshape(-1, 3)


def lever(odom: Array, tag_m: Array) -> Array:
    """(2,) where the tag is in odom, the base at (3,) there and the tag at (2,) in base."""
    return np.asarray(odom[:2] + rotation(float(odom[2])) @ tag_m)
