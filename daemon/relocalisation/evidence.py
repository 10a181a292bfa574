"""What a view says of poses: how much likelier it is there than at a wrong place of the same ceiling.

Three things are counted: features that a landmark of their type explains, features where the map knows that there are
none, and landmarks that should be seen and are not. What a wrong place explains by chance is measured on the map: how
often a landmark, moved by whole tiles, finds one of its type. So a joint between tiles says next to nothing and a
lamp says much, unless lamps hang in a pattern, in which case they say little too.

Wrong places are of two kinds: any, and those that are as like this one as any. Which kind a place is stays so however
often it is looked at, so both are weighed apart, and only their sums over all views are put together.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES, TYPE_MISTAKEN, turned_type
from ceilvo.daemon.odometry.sight import crowd, is_in
from ceilvo.daemon.relocalisation.coverage import VIEWS, Coverage
from ceilvo.daemon.relocalisation.place_index.blocks import fine
from ceilvo.daemon.relocalisation.place_index.type_grid import TypeGrid
from ceilvo.types import Array, Ints, Landmarks, Observations

REACH_M = 0.1
"""A feature so near a landmark of its type is that landmark: ten sigmas of both, and a third of the smallest tile."""
CELL_M = 0.04
"""Side of a cell of the pictures that are looked into; chosen: 0.02 m more or less of REACH_M."""
CHANGED = np.array([0.0, 0.05, 0.15, 0.35])
"""Fractions of a view that may be other than when it was mapped."""
UNMAPPED_COMMON = 0.01
"""Chance that a joint between tiles on known ground is not in the map; 0.001 was measured, see coverage.VIEWS."""
UNMAPPED_FIRST, UNMAPPED_VIEWS = 6.0, 3.0
"""The same of rarer types, that are seen now and then only: 1 / (6 + n / 3) after n views showed the ground. Measured
0.16, 0.11, 0.09, 0.06, 0.03, 0.015 at 6, 15, 25, 40, 80 and 150 views (two rooms, first laps, seeds 501 and 502)."""
_VIEWS_PER_STEP = 8
"""Views are told apart in steps of so many."""
CHANGED_CHANCE = np.array([0.9, 0.08, 0.015, 0.005])
"""How likely each of those is; chosen: ceilings change seldom and mostly little."""
INDEPENDENCE = 0.5
"""Worth of a feature in those of a view: crossings share lines; chosen."""
LAMP_CELL_M, LAMP_FEATURES = 0.4, 4.0
"""Rare features of a cell and the eight around it are one lamp's, and are worth so many together: where one corner is,
the others are; chosen."""
COMMON = 0.8
"""A type that a wrong place explains more often than this proves no place; chosen."""
ALIKE = 0.1
"""Of wrong places, how many are as like this one as any: lamps hang in a pattern, and go on so; chosen."""
OTHER_BY_CHANCE = 0.2
"""Of a wrong place's features without a landmark, at how many there is one of another rare type; chosen."""
FEWEST_SAMPLES, ENOUGH = 8, 0.3
"""Landmarks, moved onto known ground, that it takes to measure how often chance explains them, and the same as a part
of all; chosen."""
UNMEASURED = 0.5
"""How often chance explains a feature where the map is too small to tell."""
MOST_VISIBLE = 0.8
"""A landmark's own visibility is believed up to here: it was counted from other spots."""
CLOSE = 15.0
"""Log-likelihood under the best pose from which landmarks that are not seen are no longer looked for; chosen."""
MOST_RARE, MOST_COMMON = 40, 16
"""Features of a view that are weighed at every place, for time: of types that tell places apart, and of others."""
AT_ONCE = 256
"""Poses weighed at once, so that their arrays stay in the cache; chosen."""
_VISIBLE = np.uint16(1 << 15)
_QUARTER = 0.5 * np.pi


def _bits(pictures: list[NDArray[np.uint8]]) -> NDArray[np.uint16]:
    out = np.zeros(pictures[0].shape, np.uint16)
    for bit, picture in enumerate(pictures):
        out |= picture.astype(np.uint16) << np.uint16(bit)
    return out


@dataclass(frozen=True, slots=True)
class TypeRaster:
    """For every cell of a box the types that lie within REACH_M, as bits; outside of the box there is nothing."""

    low: Ints
    cells: NDArray[np.uint16]

    @staticmethod
    def of(xy_m: Array, crossing_type: Ints, corners_m: Array | None = None) -> TypeRaster:
        """Of points (L, 2) with their types (L,); corners (V, 2): of a convex region that bit 15 says."""
        pad = int(np.ceil(REACH_M / CELL_M)) + 1
        everything = xy_m if corners_m is None else np.concatenate([xy_m, corners_m])
        if not len(everything):
            return TypeRaster(np.zeros(2, np.int64), np.zeros((1, 1), np.uint16))
        low = np.floor(np.min(everything, axis=0) / CELL_M).astype(np.int64) - pad
        high = np.floor(np.max(everything, axis=0) / CELL_M).astype(np.int64) + pad
        shape = tuple((high - low + 1)[::-1])
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pad - 1, 2 * pad - 1))
        column, row = (np.floor(xy_m / CELL_M).astype(np.int64) - low).T
        pictures = [np.zeros(shape, np.uint8) for _ in range(CROSSING_TYPES)]
        for t in np.unique(crossing_type):
            of = crossing_type == t
            pictures[t][row[of], column[of]] = 1
            pictures[t] = np.asarray(cv2.dilate(pictures[t], disc), np.uint8)
        bits = _bits(pictures)
        if corners_m is not None and len(corners_m) > 2:
            seen = np.zeros(shape, np.uint8)
            cv2.fillConvexPoly(seen, np.round(corners_m / CELL_M - 0.5 - low).astype(np.int32), 1)
            bits |= seen * _VISIBLE
        return TypeRaster(low, bits)

    def at(self, xy_m: Array) -> NDArray[np.uint16]:
        """(...,) bits at points (..., 2)."""
        cell = np.floor(xy_m * (1.0 / CELL_M)).astype(np.int64) - self.low
        column, row = cell[..., 0], cell[..., 1]
        height, width = self.cells.shape
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        flat = np.where(inside, row * width + column, 0)
        return np.asarray(np.where(inside, self.cells.reshape(-1)[flat], np.uint16(0)), np.uint16)

    def has(self, xy_m: Array, crossing_type: Ints) -> NDArray[np.bool_]:
        """(...,) whether there is a point of the type (...,) within reach."""
        return is_in(self.at(xy_m), crossing_type)


def combined(log_ratio: Array) -> Array:
    """(...,) log-likelihood ratio against all wrong places, of (..., 2) against any and against one that is alike."""
    return np.asarray(-np.logaddexp(np.log(1.0 - ALIKE) - log_ratio[..., 0], np.log(ALIKE) - log_ratio[..., 1]))


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The part of the map that poses are weighed on, and what chance explains of it.

    Attributes:
        landmarks: of the map, all that can be seen from the poses.
        raster: the same to look into.
        coverage: which ground the map knows.
        chance: (2, 9) how often a wrong place explains a feature of each type: any, and the most alike.
        reach_m: how far from the tracked pose all that a pose sees is in it.
    """

    landmarks: Landmarks
    raster: TypeRaster
    coverage: Coverage
    chance: Array
    reach_m: float

    @staticmethod
    def of(landmarks: Landmarks, coverage: Coverage, chance: Array, reach_m: float) -> Surroundings:
        raster = TypeRaster.of(landmarks.xy_map_m, landmarks.crossing_type)
        return Surroundings(landmarks, raster, coverage, chance, reach_m)


def chance_matches(landmarks: Landmarks, raster: TypeRaster, coverage: Coverage, shifts: Array) -> Array:
    """(2, 9) how often a landmark of each type, moved by a shift, finds one of its type: of all shifts (S, 2), and of
    the one that is most alike.

    That shift is chosen by all types but the commonest together, for the best of many is good by chance where a type
    has few landmarks; for the same reason such a type takes the rate of all.
    """
    kinds = np.bincount(landmarks.crossing_type, minlength=CROSSING_TYPES)
    if not len(shifts) or not len(landmarks):
        return np.full((2, CROSSING_TYPES), UNMEASURED)
    at = landmarks.xy_map_m + shifts[:, None]
    known = coverage.knows(at)
    found = raster.has(at, np.broadcast_to(landmarks.crossing_type, at.shape[:2])) & known
    of = np.eye(CROSSING_TYPES)[landmarks.crossing_type]
    tried, hits = known @ of, found @ of
    common = int(np.argmax(kinds))
    rare = np.arange(CROSSING_TYPES) != common
    all_tried, all_hits = tried[:, rare].sum(axis=1), hits[:, rare].sum(axis=1)
    rate = (all_hits + 1.0) / (all_tried + 2.0)
    enough = all_tried >= max(FEWEST_SAMPLES, ENOUGH * float(kinds[rare].sum()))
    out = np.full((2, CROSSING_TYPES), UNMEASURED)
    if np.any(enough):
        best = int(np.argmax(np.where(enough, rate, 0.0)))
        pooled = float(np.sum(all_hits[enough]) / np.sum(all_tried[enough]))
        out[0] = (hits[enough].sum(axis=0) + FEWEST_SAMPLES * pooled) / (tried[enough].sum(axis=0) + FEWEST_SAMPLES)
        out[1] = np.maximum((hits[best] + FEWEST_SAMPLES * rate[best]) / (tried[best] + FEWEST_SAMPLES), out[0])
    out[:, common] = float(np.max((hits[:, common] + 1.0) / (tried[:, common] + 2.0)))
    return np.asarray(np.clip(out, 0.02, 0.98))


class ViewEvidence:
    """One view, to be weighed at many poses.

    Args:
        worth: (K,) of each feature in those of a view from new ground: what was looked at before says less. Not so
            against a wrong place that is alike, which shows another part of what differs at every spot.
    """

    def __init__(self, view: Observations, around: Surroundings, worth: Array) -> None:
        self._which = _telling(around.chance[0, view.crossing_type])
        rare = around.chance[0] < COMMON
        self._view, self._around = view.of(self._which), around
        self._expected = around.landmarks.of(rare[around.landmarks.crossing_type])  # the others are seen anywhere
        self._lamp = _of_lamp(self._view.xy_base_m, rare[self._view.crossing_type])
        self._expected_lamp = _of_lamp(self._expected.xy_map_m, np.ones(len(self._expected), bool))
        self._gain, self._mistaken, self._loss = _tables(around.chance)
        self._rare = np.uint16(np.sum(1 << np.flatnonzero(rare)))
        self._types = np.array([turned_type(self._view.crossing_type, t) for t in range(4)])
        self._raster = TypeRaster.of(view.xy_base_m, view.crossing_type, view.visible_m)
        self._seen_as = np.array([turned_type(np.arange(CROSSING_TYPES), -t) for t in range(4)])
        self.take(worth)

    def take(self, worth: Array) -> None:
        """From now on features are of another worth (K,)."""
        own = worth[self._which]
        old = float(np.mean(own)) if len(own) else 0.0
        self._worth = _by_kind(own * self._lamp, np.sqrt(own) * self._lamp)
        self._landmarks_worth = _by_kind(old * self._expected_lamp, np.sqrt(old) * self._expected_lamp).T

    def log_ratio(self, poses: Array) -> Array:
        """(M, 2) log-likelihood of the view at poses (M, 3) over that at a wrong place: any, and one that is alike.

        What is missing is looked for only where what is there leaves a chance; it can only count against a pose.
        """
        score = self._features(poses)
        out = _mixed(score)
        whole = combined(out)
        near = np.flatnonzero(whole > np.max(whole, initial=-np.inf) - CLOSE)
        out[near] = _mixed(score[near] + self._missed(poses[near]))
        return out

    @property
    def reach_m(self) -> float:
        return self._around.reach_m

    def log_ratio_in(self, grid: TypeGrid, poses: Array) -> Array:
        """(M, 2) the same for poses (M, 3) anywhere on the map, without what is missing: at least what it would be."""
        out = np.empty((len(poses), 2))
        for part in np.array_split(np.arange(len(poses)), len(poses) // AT_ONCE + 1):
            at = _moved(poses[part], self._view.xy_base_m)
            out[part] = _mixed(self._scored(poses[part], grid.bits(fine(at[..., 0]), fine(at[..., 1]))))
        return out

    def _turns(self, poses: Array) -> Ints:
        return np.asarray(np.round((self._view.heading_rad - poses[:, 2]) / _QUARTER).astype(np.int64) % 4)

    def _features(self, poses: Array) -> Array:
        """(M, R) of what is seen, for each fraction of change."""
        return self._scored(poses, self._around.raster.at(_moved(poses, self._view.xy_base_m)))

    def _scored(self, poses: Array, bits: NDArray[np.uint16]) -> Array:
        """(M, R) by the types that the map has where features (M, K) are seen."""
        types = self._types[self._turns(poses)]
        views = self._around.coverage.views(_moved(poses, self._view.xy_base_m))
        step = views // _VIEWS_PER_STEP
        matched, other = is_in(bits, types), bits & self._rare > 0
        none = np.where(other[..., None], self._mistaken[step, types], self._loss[step, types])
        each = np.where(matched[..., None], self._gain[step, types], none)
        each *= np.where(matched, np.minimum(views / VIEWS, 1.0), views >= VIEWS)[..., None]
        return np.asarray(np.einsum("mkr,rk->mr", each, self._worth))

    def _missed(self, poses: Array) -> Array:
        """(M, R) of landmarks that should be seen and are not."""
        landmarks = self._expected
        out = np.zeros((len(poses), 2 * len(CHANGED)))
        if not len(self._view.visible_m) or not len(landmarks):
            return out
        hit = np.minimum(landmarks.visibility, MOST_VISIBLE)[:, None] * (1.0 - CHANGED)
        by_chance = self._around.chance[:, landmarks.crossing_type]
        surprise = [np.minimum(np.log((1.0 - hit) / (1.0 - q[:, None])), 0.0) for q in by_chance]
        kind = self._seen_as[self._turns(poses)][:, landmarks.crossing_type]
        off = landmarks.xy_map_m - poses[:, None, :2]
        c, s = np.cos(poses[:, 2:3]), np.sin(poses[:, 2:3])
        back = np.stack([c * off[..., 0] + s * off[..., 1], c * off[..., 1] - s * off[..., 0]], axis=-1)
        bits = self._raster.at(back)
        missed = (bits & _VISIBLE > 0) & ~is_in(bits, kind) & (bits & self._rare == 0)
        return np.asarray(missed @ (np.concatenate(surprise, axis=1) * self._landmarks_worth))


def _by_kind(any_: Array, alike: Array) -> Array:
    """(2 R, N) worths (N,) against either kind of wrong place, for every fraction of change."""
    return np.repeat(np.stack([any_, alike]), len(CHANGED), axis=0)


def _of_lamp(xy_m: Array, rare: NDArray[np.bool_]) -> Array:
    """(N,) worth of features (N, 2) beside those of the same lamp; of a feature that is not rare 1."""
    out = np.ones(len(xy_m))
    out[rare] = np.minimum(LAMP_FEATURES / np.maximum(crowd(xy_m[rare], LAMP_CELL_M), 1.0), 1.0)
    return out


def _mixed(score: Array) -> Array:
    """(M, 2) over all fractions of change, of scores (M, 2 R)."""
    kinds = (INDEPENDENCE * score).reshape(-1, 2, len(CHANGED)) + np.log(CHANGED_CHANCE)
    return np.asarray(np.logaddexp.reduce(kinds, axis=2))


def _telling(chance: Array) -> NDArray[np.bool_]:
    """(K,) features that are weighed: those that chance explains least, and a few others."""
    out = np.zeros(len(chance), bool)
    common = chance >= COMMON
    rare = np.flatnonzero(~common)
    out[rare[np.argsort(chance[rare], kind="stable")[:MOST_RARE]]] = True
    usual = np.flatnonzero(common)
    out[usual[:: max(len(usual) // MOST_COMMON, 1)]] = True
    return out


def _tables(chance: Array) -> tuple[Array, Array, Array]:
    """(V, 9, 2 R) log-likelihood ratios of a feature with a landmark, with one of another type, and without, by steps
    of views and type; against any wrong place and against one like it, for every fraction of change."""
    views = _VIEWS_PER_STEP * np.arange(256 // _VIEWS_PER_STEP)
    rare = 1.0 / (UNMAPPED_FIRST + views / UNMAPPED_VIEWS)
    unmapped = np.where(chance[0] < COMMON, rare[:, None], UNMAPPED_COMMON)[..., None]
    unmapped = unmapped + (1.0 - unmapped) * CHANGED
    wrong = [q[:, None] for q in chance]
    mistaken, by_chance = TYPE_MISTAKEN[:, None], OTHER_BY_CHANCE
    gains = [np.log((1.0 - unmapped) / q) for q in wrong]  # a landmark of any place is mistaken as often
    gains = [np.where(q < COMMON, g, np.minimum(g, 0.0)) for q, g in zip(wrong, gains, strict=True)]
    others = [np.log((1.0 - unmapped) * mistaken / (q * mistaken + (1.0 - q) * by_chance)) for q in wrong]
    others = [np.minimum(o, 0.0) for o in others]
    losses = [np.minimum(np.log(unmapped / ((1.0 - q) * (1.0 - by_chance))), 0.0) for q in wrong]
    return np.concatenate(gains, axis=2), np.concatenate(others, axis=2), np.concatenate(losses, axis=2)


def _moved(poses: Array, xy: Array) -> Array:
    """(M, K, 2) points (K, 2) in base, seen from poses (M, 3)."""
    c, s = np.cos(poses[:, 2:3]), np.sin(poses[:, 2:3])
    x, y = xy[:, 0], xy[:, 1]
    return np.stack([poses[:, :1] + c * x - s * y, poses[:, 1:2] + s * x + c * y], axis=-1)
