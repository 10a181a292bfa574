"""Modes: hypotheses of pose and map, each one Gaussian over the same landmarks, that are kept apart for a while."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceilvo.daemon.slam.conditional import Bools, View, add_blocks, hold, jacobian, noise_in_map
from ceilvo.daemon.slam.joint_map import JointMap
from ceilvo.se2 import inverse, rotation, transform, wrap, wrap_array
from ceilvo.types import Array, Ints, Motion

KEPT_UPDATES = 5
"""Modes that are near each other are one after so many updates; chosen: the next landmarks decide."""
ALIKE = 0.1
"""Squared distance of two poses, in units of their covariances together, below which they are one at once; chosen."""
FAR_M, FAR_RAD = 0.3, 0.1
"""Poses farther apart are other places, and are never mixed; chosen: the bound of a usable pose (docs/states.md), where
a turn is still nearly linear."""
LIGHT = 0.01
"""Of the first mode's weight; a near one that is lighter is dropped, for the first explains what it does; chosen."""
FAINT = 1e-3
"""The same of a far one: where one refused feature is rather an outlier, two in a row are not; chosen."""
MOST = 4
"""Modes; chosen: each costs an update of its own."""


@dataclass(slots=True)
class Mode:
    """One hypothesis.

    Attributes:
        weight: its probability.
        mean, cov: of pose and landmarks, as in JointMap.
        ids: (W,) of the landmarks.
        slipping: (3,) probability that the wheels were slipping at the last update, by kind.
        age: updates since it was split off.
    """

    weight: float
    mean: Array
    cov: Array
    ids: Ints
    slipping: Array
    age: int = 0

    @staticmethod
    def of(j: JointMap, slipping: Array) -> Mode:
        """The only one; it shares its arrays with the joint map."""
        return Mode(1.0, j.mean, j.cov, j.ids[j.label_of], slipping)

    def move(self, motion: Motion) -> None:
        """As the joint map's pose moves, in place."""
        JointMap(self.mean, self.cov).move(motion)

    def follow(self, j: JointMap) -> None:
        """Take over births and deaths: a newborn landmark stands to this pose as it does to the joint map's.

        One that came back from the table is correlated with no pose.
        """
        ids = j.ids[j.label_of]
        if np.array_equal(ids, self.ids):
            return
        slot = {int(i): s for s, i in enumerate(self.ids)}
        old = np.array([slot.get(int(i), -1) for i in ids], np.int64)
        mean, cov = np.zeros(len(j.mean)), np.zeros(j.cov.shape)
        to, source = _rows(np.flatnonzero(old >= 0)), _rows(old[old >= 0])
        mean[to], cov[np.ix_(to, to)] = self.mean[source], self.cov[np.ix_(source, source)]
        for s in np.flatnonzero(old < 0):
            _place(j, slice(3 + 2 * int(s), 5 + 2 * int(s)), mean, cov)
        self.mean, self.cov, self.ids = mean, cov, ids

    def view(self, view: View, rows: Ints) -> View:
        """A view with the landmarks as they are here; rows (2 K,) of the state, none on a known map."""
        if not len(rows):
            joint = view.joint.copy()
            joint[:3, :3] = self.cov[:3, :3]
            return replace(view, joint=joint)
        rows = np.concatenate([np.arange(3), rows])
        return replace(view, landmark=self.mean[rows[3:]].reshape(-1, 2), joint=self.cov[np.ix_(rows, rows)])


def _rows(slots: Ints) -> Ints:
    first = 3 + 2 * slots
    return np.concatenate([np.arange(3), np.column_stack([first, first + 1]).ravel()])


def _place(j: JointMap, at: slice, mean: Array, cov: Array) -> None:
    """A landmark that is new in the joint map, in another mode's mean and cov."""
    if not np.any(j.cov[at, :3]):
        mean[at], cov[at, at] = j.mean[at], j.cov[at, at]
        return
    there = transform(mean[:3], transform(inverse(j.pose), j.mean[at][None]))
    h, h_joint = jacobian(there - mean[:2]), jacobian(j.mean[at][None] - j.pose[:2])
    turn = rotation(float(mean[2] - j.pose[2]))
    noise = turn @ (j.cov[at, at] - h_joint @ j.pose_cov @ h_joint.T) @ turn.T
    cross = h @ cov[:3]
    mean[at], cov[at], cov[:, at] = there[0], cross, cross.T
    cov[at, at] = h @ cov[:3, :3] @ h.T + noise


def merged(modes: list[Mode]) -> Mode:
    """One Gaussian with the weight, mean and covariance of all together."""
    if len(modes) == 1:
        return modes[0]
    weight = np.array([m.weight for m in modes])
    share = weight / np.sum(weight)
    means = np.array([m.mean for m in modes])
    means[:, 2] = means[0, 2] + wrap_array(means[:, 2] - means[0, 2])
    mean = share @ means
    off = (means - mean) * np.sqrt(share)[:, None]
    cov = sum((w * m.cov for w, m in zip(share, modes, strict=True)), off.T @ off)
    mean[2] = wrap(float(mean[2]))
    return Mode(float(np.sum(weight)), mean, 0.5 * (cov + cov.T), modes[0].ids, _slipping(modes))


def settled(modes: list[Mode], mapping: bool = False) -> tuple[list[Mode], Mode]:
    """The modes that stay apart (none when there is one), heaviest first, with weights that sum to one; what to report.

    Those near the first are mixed into it once they are old or alike. Those far from it are never mixed, they win or
    die. What is reported is the first with all that are near.

    Args:
        mapping: the map is learnt as well. Then all modes are mixed, for a wrong place builds itself a map that fits:
            with far modes one of three recorded runs ended 0.27 m off, without 0.15 m (docs/filter.md).
    """
    if len(modes) == 1:
        return [], replace(modes[0], weight=1.0)
    modes = sorted(modes, key=lambda m: -m.weight)
    first, rest = modes[0], modes[1:]
    near = [m for m in rest if mapping or not _far(first, m)]
    far = [m for m in rest if not mapping and _far(first, m) and m.weight > FAINT * first.weight]
    strong = [m for m in near if m.weight > LIGHT * first.weight]
    young = [m for m in strong if m.age < KEPT_UPDATES and _distance2(first, m) > ALIKE]
    apart = sorted([*young, *far], key=lambda m: -m.weight)[: MOST - 1]
    leader = merged([first, *_without(strong, apart)])
    leader = replace(leader, slipping=_slipping([first, *_without(near, apart)]))
    told = merged([first, *strong])
    share = told.weight / (told.weight + sum(m.weight for m in far))
    told = replace(told, mean=told.mean.copy(), cov=told.cov.copy(), weight=share, slipping=_slipping([first, *near]))
    kept = [leader, *apart] if apart else []
    total = sum(m.weight for m in kept)
    return [replace(m, weight=m.weight / total) for m in kept], told


def agree(modes: list[Mode], j: JointMap, held: Bools) -> bool:
    """Whether all modes have the rows `held`, (S,) or (0,), as the joint map has them."""
    which = np.flatnonzero(held)
    square = np.ix_(which, which)
    return all(np.array_equal(m.mean[which], j.mean[which]) for m in modes) and all(
        np.array_equal(m.cov[square], j.cov[square]) for m in modes
    )


def restore(modes: list[Mode], j: JointMap, held: Bools) -> None:
    """Give modes that were mixed the rows `held` of the joint map again, in place: the same but for rounding."""
    which = np.flatnonzero(held)
    square = np.ix_(which, which)
    for m in modes if len(which) else ():
        m.mean[which], m.cov[square] = j.mean[which], j.cov[square]


def _without(modes: list[Mode], those: list[Mode]) -> list[Mode]:
    return [m for m in modes if not any(m is t for t in those)]


def _slipping(modes: list[Mode]) -> Array:
    """(3,) probability by kind; that of modes too light to be kept makes the next slip of the kind likelier."""
    weight = np.array([m.weight for m in modes])
    return np.asarray(weight @ np.array([m.slipping for m in modes]) / np.sum(weight), np.float64)


def corrected(mean: Array, cov: Array, view: View, rows: Ints, fitted: Array, known: bool) -> tuple[Array, Array]:
    """Step of pose and map, and their covariance, by the Kalman update with the features of a view.

    On a known map it is linearised at the fitted pose. A map in the making turns with the pose's heading, and the
    covariance must not learn of that common turn: the features' lever is the estimate's, not the measured one.

    Args:
        view: of features that are believed; heading_var is infinite where the heading is not.
        rows: (2 K,) of their landmarks in the state, none on a known map.
        fitted: (3,) pose, the curve's.
    """
    k = 2 * len(view)
    at = fitted if known else mean[:3].copy()
    arm = view.xy @ rotation(float(at[2])).T
    heading = [[0.0, 0.0, 1.0]] if np.isfinite(view.heading_var) else np.empty((0, 3))
    h = np.concatenate([jacobian(arm if known else view.landmark - at[:2]), heading])
    if not len(h):
        return np.zeros(len(mean)), cov
    off = at - mean[:3]
    off[2] = wrap(float(off[2]))
    innovation = h @ off
    innovation[:k] -= (at[:2] + arm - view.landmark).ravel()
    innovation[k:] = wrap_array(view.heading - mean[2:3])[: len(h) - k]
    cross = h @ cov[:3]
    if known:
        total = cross[:, :3] @ h.T
        total[:k, :k] += view.joint[3:, 3:]
    else:
        cross[:k] -= cov[rows]
        total = cross[:, :3] @ h.T
        total[:, :k] -= cross[:, rows]
    add_blocks(total[:k, :k], noise_in_map(float(fitted[2]), view.var * view.inflation))
    total[k:, k:] += view.heading_var
    white = np.linalg.solve(np.linalg.cholesky(total), np.column_stack([innovation, cross]))
    cross = np.ascontiguousarray(white[:, 1:])
    step, less = cross.T @ white[:, 0], cross.T @ cross  # a product with itself comes out symmetric
    hold(step, less, view.held)
    return step, cov - less


def _far(a: Mode, b: Mode) -> bool:
    apart = a.mean[:3] - b.mean[:3]
    return bool(np.hypot(*apart[:2]) > FAR_M or abs(wrap(float(apart[2]))) > FAR_RAD)


def _distance2(a: Mode, b: Mode) -> float:
    off = a.mean[:3] - b.mean[:3]
    off[2] = wrap(float(off[2]))
    return float(off @ np.linalg.solve(a.cov[:3, :3] + b.cov[:3, :3], off))
