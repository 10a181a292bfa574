"""Unscented Kalman filter on pose and landmarks jointly; sigma points on the pose and what is in view only."""

from __future__ import annotations

import numpy as np

from ceilvo.config import Filter
from ceilvo.daemon.slam.association import NIS_CAP
from ceilvo.daemon.slam.conditional import View, hold
from ceilvo.daemon.slam.joint_filter import Innovations, JointFilterState
from ceilvo.daemon.slam.pose_filter import spread
from ceilvo.se2 import wrap, wrap_array
from ceilvo.types import Array, Ints, Motion

NO_HEADING_VAR_RAD2 = 1e12
"""In place of an infinite variance, with which the linear algebra could not be done."""


class UkfRule:
    """An UpdateRule: the rival of the paper's table 1, ungated, and the one that is hard to beat, gated (ukf_gate)."""

    def __init__(self, settings: Filter) -> None:
        self._settings = settings

    def fresh(self, rng: np.random.Generator) -> None:
        """It remembers nothing."""

    def move(self, state: JointFilterState, motion: Motion) -> None:
        state.joint.move(motion)

    def jumped(self, state: JointFilterState) -> None:
        """It does not matter."""

    def curve(self, state: JointFilterState) -> tuple[float, float]:
        return float(self._settings.particles), float("nan")

    def certainty(self, state: JointFilterState) -> float:
        return 1.0

    def particles(self, state: JointFilterState) -> tuple[Array, Array]:
        """Draws from the Gaussian, for pictures."""
        n = self._settings.particles
        joint = state.joint
        return spread(joint.pose, joint.pose_cov, n, np.random.default_rng(0)), np.full(n, 1.0 / n)

    def absorb(self, state: JointFilterState, view: View, rows: Ints) -> Innovations:
        predicted, own, cross = unscented(state.joint.pose, view)
        seen = np.append(view.xy.ravel(), view.heading)
        innovation = seen - predicted
        innovation[-1] = wrap(float(innovation[-1])) if np.isfinite(view.heading_var) else 0.0
        noise = np.append((view.var * view.inflation).ravel(), min(view.heading_var, NO_HEADING_VAR_RAD2))
        total = own + np.diag(noise)
        keep = np.ones(len(view) + 1, bool)
        chi2 = np.array([_mahalanobis(innovation, total, i, len(view)) for i in range(len(view) + 1)])
        if self._settings.ukf_gate:
            keep = chi2 <= self._settings.gate_chi2
        dof = 2 * len(view)
        bare = own + np.diag(np.append(view.var.ravel(), noise[-1]))
        nis = [min(_mahalanobis(innovation, bare, i, len(view)), NIS_CAP) for i in range(len(view))]
        used = np.append(np.repeat(keep[:-1], 2), keep[-1])
        if np.any(used):
            _correct(state, view, rows, innovation[used], total[np.ix_(used, used)], cross[:, used])
        return Innovations(keep[:-1], float(np.mean(nis)) / 2 if dof else 0.0, dof)


def _correct(state: JointFilterState, view: View, rows: Ints, innovation: Array, total: Array, cross: Array) -> None:
    """Kalman update; landmarks out of view follow by their correlation with pose and view."""
    j = state.joint
    block = np.concatenate([np.arange(3), rows]).astype(np.int64)
    local = cross[: len(block)]  # a known map does not learn
    if state.known is None:
        link = np.linalg.lstsq(view.joint, j.cov[block], rcond=1e-13)[0]
        local = link.T @ cross
    gain = np.linalg.solve(total, local.T).T
    step, less = gain @ innovation, gain @ local.T
    hold(step, less, view.held)
    j.mean += step
    j.mean[2] = wrap(float(j.mean[2]))
    j.cov -= less
    j.cov = 0.5 * (j.cov + j.cov.T)


def unscented(pose: Array, view: View) -> tuple[Array, Array, Array]:
    """Predicted observation (2 K + 1,), its covariance without noise, and its covariance with pose and landmarks."""
    n = len(view.joint)
    values, vectors = np.linalg.eigh(view.joint)
    root = vectors * np.sqrt(np.maximum(values, 0.0) * n)
    off = np.concatenate([root, -root], axis=1).T
    at = np.concatenate([pose, view.landmark.ravel()]) + off
    c, s = np.cos(at[:, 2:3]), np.sin(at[:, 2:3])
    dx, dy = at[:, 3::2] - at[:, :1], at[:, 4::2] - at[:, 1:2]
    z = np.empty((2 * n, n - 2))
    z[:, 0:-1:2], z[:, 1:-1:2] = c * dx + s * dy, -s * dx + c * dy
    z[:, -1] = pose[2] + wrap_array(at[:, 2] - pose[2])
    mean = np.mean(z, axis=0)
    d = z - mean
    return mean, d.T @ d / (2 * n), off.T @ d / (2 * n)


def _mahalanobis(innovation: Array, total: Array, i: int, k: int) -> float:
    """Of feature i, or of the heading for i = k."""
    at = slice(2 * i, 2 * i + 2) if i < k else slice(2 * k, 2 * k + 1)
    return float(innovation[at] @ np.linalg.solve(total[at, at], innovation[at]))
