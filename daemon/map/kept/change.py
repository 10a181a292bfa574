"""What another program made of a map while a robot was on it, and what the robot learnt meanwhile, brought onto that.

Pure. Landmarks are the same by their ids and types; where the map was turned or moved as a whole, the robot's pose and
what it learnt go along, and so they do where a refinement moved it a little here and there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.se2 import rotation, transform, wrap
from ceilvo.types import Array, Landmarks, Pose

FEWEST, SHARE = 8, 0.5
"""Landmarks that two maps must have in common, and how much that is of the smaller one; chosen: what is fewer may have
the same numbers by chance."""
BEND_M, MOST_SHARE = 0.3, 0.8
"""That share of them is moved by less than this against the rest, or it is another map; chosen: half of a small tile,
and ten times what a refinement moves. The others have the same number and type by chance."""
AXES_RAD = np.radians(5.0)
"""Between the ceiling's axes as the two maps have them; chosen."""
_NEAR = 8
"""Landmarks around a point that say how the map was moved there; chosen."""
_ROUNDED_M, _ROUNDED = 1e-9, 1e-9
"""Metres, and share of a variance, below which a landmark is taken not to have moved; chosen: far above what turning a
building's coordinates rounds, far below any measurement."""
_COLUMNS = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")


@dataclass(frozen=True)
class Change:
    """From a robot's map to another one of the same landmarks.

    Attributes:
        there_from_here: (3,) how the map was moved as a whole.
        xy_m: (P, 2) in the new map, of landmarks that both have.
        bend_m: (P, 2) by which each was moved besides.
    """

    there_from_here: Array
    xy_m: Array
    bend_m: Array

    @staticmethod
    def between(here: StoredMap, there: StoredMap) -> Change | None:
        """None where the two are not one map that was changed."""
        a, b = here.landmarks, there.landmarks
        _, i, j = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
        same = a.crossing_type[i] == b.crossing_type[j]
        i, j = i[same], j[same]
        if len(i) < max(FEWEST, SHARE * min(len(a), len(b))):
            return None
        moved = _rigid(a.xy_map_m[i], b.xy_map_m[j])
        bend = b.xy_map_m[j] - transform(Pose(moved), a.xy_map_m[i])
        axes = float(wrap(there.map_axis_rad - here.map_axis_rad - float(moved[2])))
        near = np.hypot(*bend.T) <= BEND_M
        if np.count_nonzero(near) < MOST_SHARE * len(near) or abs(axes) > AXES_RAD:
            return None
        return Change(moved, b.xy_map_m[j][near], bend[near])

    def points(self, xy_m: Array) -> Array:
        """Points (N, 2) of the robot's map on the new one."""
        out = np.array(transform(Pose(self.there_from_here), xy_m)).reshape(-1, 2)
        near = min(_NEAR, len(self.xy_m))
        for n, at in enumerate(out):  # few of them, and the map may be large
            away = np.hypot(*(self.xy_m - at).T)
            out[n] = at + np.mean(self.bend_m[np.argpartition(away, near - 1)[:near]], axis=0)
        return out

    def pose(self, pose: Array) -> Pose:
        """A pose (3,) on the robot's map as one on the new map, which may be bent there: by two points around it."""
        ahead = rotation(float(pose[2])) @ np.array([1.0, 0.0])
        ends = self.points(np.stack([pose[:2] - ahead, pose[:2] + ahead]))
        way = ends[1] - ends[0]
        return Pose(np.array([*self.points(pose[None, :2])[0], float(np.arctan2(way[1], way[0]))]))

    def moved_m(self, pose: Array) -> float:
        """How far a pose (3,) lies from where it was."""
        return float(np.hypot(*(self.pose(pose) - pose)[:2]))

    def carried(self, base: Landmarks, ours: Landmarks, theirs: Landmarks) -> Landmarks:
        """The new map with what the robot learnt since.

        Args:
            base: the robot's map, as both began from it.
            ours: the robot's map now; what it learnt since has ids that the new map does not use.
            theirs: the new map. A landmark that it has no more stays away; where both changed one, the new map says
                where it was, and what the robot measured since is added.
        """
        turn = rotation(float(self.there_from_here[2]))
        out = {name: np.array(getattr(theirs, name)) for name in _COLUMNS}
        _, i, j = np.intersect1d(base.ids, ours.ids, assume_unique=True, return_indices=True)
        _, at, k = np.intersect1d(base.ids[i], theirs.ids, assume_unique=True, return_indices=True)
        i, j = i[at], j[at]
        fits = (base.crossing_type[i] == theirs.crossing_type[k]) & (ours.crossing_type[j] == base.crossing_type[i])
        bend = theirs.xy_map_m[k] - transform(Pose(self.there_from_here), base.xy_map_m[i])
        fits &= np.hypot(*bend.T) <= BEND_M
        news = fits & _is_other(base.of(i), ours.of(j))
        i, j, k = i[news], j[news], k[news]
        out["xy_map_m"][k] += (ours.xy_map_m[j] - base.xy_map_m[i]) @ turn.T
        gain = turn @ (np.linalg.inv(ours.cov_m2[j]) - np.linalg.inv(base.cov_m2[i])) @ turn.T
        out["cov_m2"][k] = _surer(theirs.cov_m2[k], gain)
        for name in ("sightings", "expected"):
            more = getattr(ours, name)[j] - getattr(base, name)[i]
            out[name][k] = np.maximum(out[name][k] + more, 0)
        gone = np.setdiff1d(np.intersect1d(base.ids, theirs.ids), ours.ids)
        stays = ~np.isin(theirs.ids, gone)
        new = ours.of(~np.isin(ours.ids, base.ids))
        new = replace(new, xy_map_m=self.points(new.xy_map_m), cov_m2=turn @ new.cov_m2 @ turn.T)
        return Landmarks(*(np.concatenate([out[name][stays], getattr(new, name)]) for name in _COLUMNS))


def _rigid(a: Array, b: Array) -> Array:
    """b_from_a (3,) by least squares of points (P, 2), those that fit badly left out of a second one."""
    keep = np.ones(len(a), bool)
    for _ in range(2):
        from_, to = a[keep] - a[keep].mean(axis=0), b[keep] - b[keep].mean(axis=0)
        dot, cross = np.sum(from_ * to), np.sum(from_[:, 0] * to[:, 1] - from_[:, 1] * to[:, 0])
        angle = float(np.arctan2(cross, dot))
        shift = b[keep].mean(axis=0) - rotation(angle) @ a[keep].mean(axis=0)
        found = np.array([*shift, angle])
        off = np.hypot(*(b - transform(Pose(found), a)).T)
        keep = off <= max(3.0 * float(np.median(off)), 1e-9)
    return found


def _is_other(a: Landmarks, b: Landmarks) -> NDArray[np.bool_]:
    """(L,) which say another thing in the second."""
    other = np.any(a.xy_map_m != b.xy_map_m, axis=1) | np.any(a.cov_m2 != b.cov_m2, axis=(1, 2))
    return np.asarray(other | (a.sightings != b.sightings) | (a.expected != b.expected))


def _surer(cov_m2: Array, gain: Array) -> Array:
    """Covariances (N, 2, 2) with information (N, 2, 2) added, of which what is negative is none."""
    values, axes = np.linalg.eigh(0.5 * (gain + np.swapaxes(gain, 1, 2)))
    more = np.einsum("nij,nj,nkj->nik", axes, np.maximum(values, 0.0), axes)
    out = np.linalg.inv(np.linalg.inv(cov_m2) + more)
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


def unmoved(landmarks: Landmarks, before: Landmarks) -> Landmarks:
    """Those that lie where they lay, to the last bit: on their way into another frame and back they are rounded."""
    at = np.searchsorted(before.ids, landmarks.ids)
    known = np.flatnonzero(at < len(before))
    known = known[before.ids[at[known]] == landmarks.ids[known]]
    old = before.of(at[known])
    same = np.all(np.abs(old.xy_map_m - landmarks.xy_map_m[known]) < _ROUNDED_M, axis=1)
    off = np.abs(old.cov_m2 - landmarks.cov_m2[known])
    same &= np.all(off <= _ROUNDED * np.trace(old.cov_m2, axis1=1, axis2=2)[:, None, None], axis=(1, 2))
    xy, cov = landmarks.xy_map_m.copy(), landmarks.cov_m2.copy()
    xy[known[same]], cov[known[same]] = old.xy_map_m[same], old.cov_m2[same]
    return replace(landmarks, xy_map_m=xy, cov_m2=cov)
