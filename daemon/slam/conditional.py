"""What a view says of a pose, the map being uncertain and shared, and how pose and map take a correction by it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.slam.association import chi2_of
from ceilvo.daemon.slam.pose_filter import JITTER
from ceilvo.se2 import rotation, wrap_array
from ceilvo.types import Array, Ints

Bools = NDArray[np.bool_]
_POSE = np.arange(3)


@dataclass(frozen=True, slots=True)
class View:
    """Features of one update with the landmarks that explain them.

    xy, var: (K, 2) features in base and their variances; landmark: (K, 2) means in map; joint: (3 + 2 K, 3 + 2 K)
    covariance of pose and landmarks; heading: measured, with its variance; inflation: of var, because features of a
    frame share errors; held: (3 + 2 W,) rows of the joint state that learn nothing, or (0,) for none, see hold().
    """

    xy: Array
    var: Array
    landmark: Array
    joint: Array
    heading: float
    heading_var: float
    inflation: float
    held: Bools = field(default_factory=lambda: np.zeros(0, bool))

    def __len__(self) -> int:
        return len(self.xy)

    def of(self, which: Ints, inflation: float) -> View:
        """The features `which` in that order, with another inflation."""
        rows = np.concatenate([_POSE, np.column_stack([3 + 2 * which, 4 + 2 * which]).ravel()])
        joint = self.joint[rows[:, None], rows]
        return replace(
            self,
            xy=self.xy[which],
            var=self.var[which],
            landmark=self.landmark[which],
            joint=joint,
            inflation=inflation,
        )


def noise_in_map(theta: float, var: Array) -> Array:
    """(K, 2, 2) of variances (K, 2) along base x and y."""
    r = rotation(theta)
    return np.asarray((r * var[:, None, :]) @ r.T, np.float64)


class Conditional:
    """p(features | pose) of one hypothesis: the landmarks given the pose are N(m + B (x - mu), C).

    Innovations are linear in (x - mu, cos theta, sin theta, 1), so those of all particles, whitened, are one product.
    """

    def __init__(self, view: View, mu: Array, cov: Array) -> None:
        self.view, self.mu = view, mu
        cross = view.joint[3:, :3]
        follow = np.linalg.solve(cov, cross.T).T
        self.total: Array = view.joint[3:, 3:] - follow @ cross.T
        add_blocks(self.total, noise_in_map(float(mu[2]), view.var * view.inflation))
        self.lower = np.linalg.cholesky(self.total) if len(view) else np.zeros((0, 0))
        self._inverse = np.linalg.inv(self.lower) if len(view) else self.lower
        x, y = view.xy[:, 0], view.xy[:, 1]
        linear = np.empty((6, 2 * len(view)))
        linear[:3] = -follow.T
        linear[0, 0::2] += 1.0
        linear[1, 1::2] += 1.0
        linear[3, 0::2], linear[3, 1::2] = x, y
        linear[4, 0::2], linear[4, 1::2] = -y, x
        linear[5] = (mu[:2] - view.landmark).ravel()
        self._linear = linear
        self._white = linear @ self._inverse.T

    def _terms(self, off: Array) -> Array:
        """(N, 6) what innovations are linear in, for poses mu + off (N, 3)."""
        out = np.empty((len(off), 6))
        out[:, :3] = off
        theta = self.mu[2] + off[:, 2]
        np.cos(theta, out=out[:, 3])
        np.sin(theta, out=out[:, 4])
        out[:, 5] = 1.0
        return out

    def distances(self, off: Array, gate: float) -> Array:
        """(N, K) squared normalised innovations at mu + off, each given the earlier ones that are within the gate."""
        terms = self._terms(off)
        white = terms @ self._white
        squares = white * white
        out: Array = squares[:, 0::2] + squares[:, 1::2]
        beyond = out > gate
        rows = np.flatnonzero(beyond.any(axis=1))
        if len(rows):
            first = int(np.argmax(beyond.any(axis=0)))
            out[rows] = self._eliminated(terms[rows] @ self._linear, white[rows], out[rows], gate, first)
        return out

    def _eliminated(self, nu: Array, white: Array, out: Array, gate: float, first: int) -> Array:
        """One feature after the other, from the first that matters; those beyond the gate do not condition others."""
        for k in range(first, out.shape[1]):
            at = slice(2 * k, 2 * k + 2)
            e = (nu[:, at] - white[:, : 2 * k] @ self.lower[at, : 2 * k].T) @ self._inverse[at, at].T
            out[:, k] = e[:, 0] ** 2 + e[:, 1] ** 2
            white[:, at] = e * (out[:, k] <= gate)[:, None]
        return out

    def log_likelihood(self, off: Array, gate: float) -> Array:
        """(N,) at mu + off, with every term saturated at the gate."""
        floor = np.exp(-0.5 * gate)
        total = np.sum(np.log(np.exp(-0.5 * self.distances(off, gate)) + floor), axis=1)
        if np.isfinite(self.view.heading_var):
            total += np.log(np.exp(-0.5 * self.heading_distance(off)) + floor)
        return np.asarray(total, np.float64)

    def heading_distance(self, off: Array) -> Array:
        """(N,) squared normalised innovation of the heading, 0 where none was measured."""
        if not np.isfinite(self.view.heading_var):
            return np.zeros(len(off))
        return np.asarray(wrap_array(off[:, 2] + (self.mu[2] - self.view.heading)) ** 2 / self.view.heading_var)


class Predicted:
    """Innovations (K, 2) in map at a predicted pose, their Jacobian (2 K, 3) and covariance (2 K, 2 K).

    `rows` (M,), `rows_h` (M, 3) and `rows_total` (M, M) are the same flat, with the heading last where it was measured.
    """

    def __init__(self, view: View, pose: Array, cov: Array) -> None:
        self.view, self.pose, self.cov = view, pose, cov
        arm = view.xy @ rotation(float(pose[2])).T
        self.h = jacobian(arm)
        cross = self.h @ view.joint[:3, 3:]
        self.total: Array = self.h @ cov @ self.h.T - cross - cross.T + view.joint[3:, 3:]
        add_blocks(self.total, noise_in_map(float(pose[2]), view.var * view.inflation))
        self.nu: Array = pose[:2] + arm - view.landmark
        self.rows, self.rows_h, self.rows_total = self.nu.ravel(), self.h, self.total
        if np.isfinite(view.heading_var):
            self.rows = np.append(self.rows, wrap_array(pose[2:] - view.heading))
            self.rows_h = np.vstack([self.h, [0.0, 0.0, 1.0]])
            self.rows_total = np.zeros((len(self.rows),) * 2)
            self.rows_total[:-1, :-1] = self.total
            self.rows_total[-1] = self.rows_total[:, -1] = self.rows_cross[2]
            self.rows_total[-1, -1] += view.heading_var

    @property
    def rows_cross(self) -> Array:
        """(3, M) covariance of the pose with the innovations."""
        cross = self.cov @ self.rows_h.T
        cross[:, : self.nu.size] -= self.view.joint[:3, 3:]
        return np.asarray(cross, np.float64)

    def chi2(self) -> Array:
        """(K,) squared normalised innovation of every feature by itself, and last of the heading if it was measured."""
        k = np.arange(len(self.nu))
        own = chi2_of(self.nu, self.total.reshape(len(k), 2, len(k), 2)[k, :, k])
        return np.append(own, self.rows[2 * len(k) :] ** 2 / np.diag(self.rows_total)[2 * len(k) :])


def nis_of(view: View, pose: Array, cov: Array, inflation: float) -> Array:
    """(K,) squared normalised innovation of every feature by itself, at cost K."""
    arm = view.xy @ rotation(float(pose[2])).T
    h = jacobian(arm).reshape(-1, 2, 3)
    own = h @ cov @ h.transpose(0, 2, 1)
    cross = h @ view.joint[:3, 3:].reshape(3, -1, 2).transpose(1, 0, 2)
    own -= cross + cross.transpose(0, 2, 1)
    own += noise_in_map(float(pose[2]), view.var * inflation)
    k = np.arange(len(view))
    own += view.joint[3:, 3:].reshape(len(k), 2, len(k), 2)[k, :, k]
    return chi2_of(pose[:2] + arm - view.landmark, own)


def given_pose_chi2(view: View, pose: Array, mu: Array, cov: Array) -> Array:
    """(K,) squared normalised innovation of every feature by itself, the pose being given."""
    follow = np.linalg.solve(cov, view.joint[:3, 3:])
    off = pose - mu
    off[2] = wrap_array(off[2:])[0]
    cross = view.joint[:3, 3:].reshape(3, -1, 2).transpose(1, 0, 2)
    own = noise_in_map(float(pose[2]), view.var * view.inflation)
    own -= follow.reshape(3, -1, 2).transpose(1, 2, 0) @ cross
    k = np.arange(len(view))
    own += view.joint[3:, 3:].reshape(len(k), 2, len(k), 2)[k, :, k]
    nu = pose[:2] + view.xy @ rotation(float(pose[2])).T - view.landmark
    return chi2_of(nu - (off @ follow).reshape(-1, 2), own)


def root_of(cov: Array) -> Array:
    """A root of a covariance, also of one that rounding has made slightly indefinite."""
    try:
        return np.asarray(np.linalg.cholesky(cov), np.float64)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(cov)
        return np.asarray(vectors * np.sqrt(np.maximum(values, JITTER[0])), np.float64)


def jacobian(arm: Array) -> Array:
    """(2 K, 3) of features in map by the pose; arm (K, 2) is from the robot to them."""
    h = np.zeros((2 * len(arm), 3))
    h[0::2, 0] = h[1::2, 1] = 1.0
    h[0::2, 2], h[1::2, 2] = -arm[:, 1], arm[:, 0]
    return h


def add_blocks(square: Array, blocks: Array) -> None:
    """Add (K, 2, 2) to the diagonal of (2 K, 2 K), in place."""
    k = np.arange(len(blocks))
    square.reshape(len(blocks), 2, len(blocks), 2)[k, :, k] += blocks


def hold(step: Array, less: Array, held: Bools) -> None:
    """Take rows out of a Kalman step (S,) and of what it takes off the covariance (S, S), in place; held: (S,) or (0,).

    What is left is Schmidt's update ("Application of state-space methods to navigation problems", 1966): the gain of
    those rows is zero. They stay as they are, and their covariance with the others is what the others' gain leaves.
    """
    if len(held):
        step[held] = 0.0
        less[np.ix_(held, held)] = 0.0


def along_the_turn(step: Array) -> Array:
    """A correction (3 + 2 W,) of pose and landmarks, its displacements along the arcs of its change of heading."""
    half = 0.5 * step[2]
    c, s = np.cos(half) * np.sinc(half / np.pi), np.sin(half) * np.sinc(half / np.pi)
    out: Array = step.copy()
    out[0], out[1] = c * step[0] - s * step[1], s * step[0] + c * step[1]
    out[3::2], out[4::2] = c * step[3::2] - s * step[4::2], s * step[3::2] + c * step[4::2]
    return out


def turn_about(cov: Array, step: Array) -> None:
    """Let the error of heading turn the estimate where it is now, not where it was before a step (3 + 2 W,); in place.

    Else a filter learns its heading from its own corrections: pose and map together may turn freely (the invariant
    error of Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency properties", 2015).
    """
    lever = np.zeros(len(step))
    lever[0], lever[1] = -step[1], step[0]
    lever[3::2], lever[4::2] = -step[4::2], step[3::2]
    half = cov[2] + (0.5 * cov[2, 2]) * lever
    change = np.outer(lever, half)
    cov += change + change.T
