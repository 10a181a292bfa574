"""What a view says of poses: how much likelier it is there than at a wrong place of the same ceiling.

Three things are counted: features that a landmark of their type explains, features where the map knows that there are
none, and landmarks that should be seen and are not. What a wrong place explains by chance is measured on the map: how
often a landmark, moved by whole tiles, finds one of its type. So a joint between tiles says next to nothing and a
lamp says much, unless lamps hang in a pattern, in which case they say little too.

Wrong places are of two kinds: any, and those that are as like this one as any. Which kind a place is stays so however
often it is looked at, so both are weighed apart, and only their sums over all views are put together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES, LINE_CROSSINGS, TYPE_MISTAKEN, turned_type
from ceilvo.daemon.odometry.lines.through import lines_through
from ceilvo.daemon.odometry.sight import is_in
from ceilvo.daemon.relocalisation import kernel
from ceilvo.daemon.relocalisation.evidence.chance import Chance
from ceilvo.daemon.relocalisation.evidence.coverage import VIEWS, Coverage
from ceilvo.daemon.relocalisation.evidence.type_raster import RARE, REACH_M, VISIBLE, TypeRaster
from ceilvo.daemon.relocalisation.evidence.worth import of_lamp, of_place, telling
from ceilvo.daemon.relocalisation.evidence.wrong_places import combined
from ceilvo.daemon.relocalisation.kernel.arguments import LINE_FEATURES, Ratios
from ceilvo.daemon.relocalisation.place_index.blocks import FINE_M, fine
from ceilvo.daemon.relocalisation.place_index.type_grid import TypeGrid
from ceilvo.types import Array, Ints, Landmarks, Observations

CHANGED = np.array([0.0, 0.05, 0.15, 0.35])
"""Fractions of a view that may be other than when it was mapped."""
UNMAPPED_COMMON = 0.01
"""Chance that a joint between tiles on known ground is not in the map; 0.001 was measured, see coverage.VIEWS. Not so
of points, though they be the commonest: a corner of hexagons comes and goes as rarer types do."""
UNMAPPED_FIRST, UNMAPPED_VIEWS = 6.0, 3.0
"""The same of rarer types, that are seen now and then only: 1 / (6 + n / 3) after n views showed the ground. Measured
0.16, 0.11, 0.09, 0.06, 0.03, 0.015 at 6, 15, 25, 40, 80 and 150 views (two rooms, first laps, seeds 501 and 502)."""
UNMAPPED_HIDDEN = 0.3
"""The same of any type under a ceiling of several heights: what is lower hides what is higher, something else from
every spot; chosen: 0.3 of the features in coffers were of no landmark yet."""
UNMAPPED_MOST = 0.5
"""The same at most where the map is found to lack more than usual; chosen: what is seen says something."""
_VIEWS_PER_STEP = 8
"""Views are told apart in steps of so many."""
CHANGED_CHANCE = np.array([0.9, 0.08, 0.015, 0.005])
"""How likely each of those is; chosen: ceilings change seldom and mostly little."""
INDEPENDENCE = 0.5
"""Worth of a feature in those of a view: crossings share lines; chosen."""
MOST_VISIBLE = 0.8
"""A landmark's own visibility is believed up to here: it was counted from other spots."""
CLOSE = 15.0
"""Log-likelihood under the best pose from which landmarks that are not seen are no longer looked for; chosen."""
AT_ONCE = 256
"""Poses weighed at once, so that their arrays stay in the cache; chosen."""
_QUARTER = 0.5 * np.pi
_TURNED = np.array([turned_type(np.arange(CROSSING_TYPES), t) for t in range(4)])
"""(4, T) every type, named by axes that are so many quarter turns further."""
_TINY = 1e-12
"""In place of a sum that is zero."""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """The part of the map that poses are weighed on, and what chance explains of it.

    Attributes:
        landmarks: of the map, all that can be seen from the poses.
        raster: the same to look into.
        coverage: which ground the map knows.
        chance: how often a wrong place explains a feature.
        reach_m: how far from the tracked pose all that a pose sees is in it.
        axis_rad: direction of the ceiling's lines in the map, modulo 90 deg.
    """

    landmarks: Landmarks
    raster: TypeRaster
    coverage: Coverage
    chance: Chance
    reach_m: float
    axis_rad: float

    @staticmethod
    def of(
        landmarks: Landmarks,
        coverage: Coverage,
        chance: Chance,
        reach_m: float,
        axis_rad: float,
        named: NDArray[np.bool_] | None = None,
    ) -> Surroundings:
        """Of landmarks, of which some (L,) may be mistaken names of others."""
        raster = TypeRaster.of(landmarks.xy_map_m, landmarks.crossing_type, chance.rare, named)
        return Surroundings(landmarks, raster, coverage, chance, reach_m, axis_rad)


class ViewEvidence:
    """One view, to be weighed at many poses.

    Args:
        worth: (K,) of each feature in those of a view from new ground: what was looked at before says less. Not so
            against a wrong place that is alike, which shows another part of what differs at every spot.
        scale: how many times as often as usual the map lacks something, see Unmapped.
    """

    def __init__(self, view: Observations, around: Surroundings, worth: Array, scale: float = 1.0) -> None:
        rare = around.chance.rare
        self._which = telling(around.chance.same[0, view.crossing_type], rare[view.crossing_type])
        self._view, self._around = view.of(self._which), around
        kind = around.landmarks.crossing_type  # common ones are seen anywhere, points are not looked for in every view
        self._expected = around.landmarks.of(rare[kind] & (kind < LINE_CROSSINGS))
        self._placed = of_place(self._view)
        self._lamp = of_lamp(self._view.xy_base_m, rare[self._view.crossing_type])
        self._expected_lamp = of_lamp(self._expected.xy_map_m, np.ones(len(self._expected), bool))
        self._expected_lines = self._lines_of(self._expected.xy_map_m, self._expected.crossing_type)
        self._ratios = _ratios(around.chance, UNMAPPED_HIDDEN if np.isfinite(view.reach_m) else 0.0, scale)
        self._rare = np.uint16(np.sum(1 << np.flatnonzero(rare)))
        self._types = _TURNED[:, self._view.crossing_type]
        self._raster = TypeRaster.of(view.xy_base_m, view.crossing_type, rare, corners_m=view.visible_m)
        self._lines = lines_through(
            self._view.xy_base_m, self._view.crossing_type, around.axis_rad - self._view.heading_rad
        )
        self._seen_as = _TURNED[[0, 3, 2, 1]]
        self.take(worth)

    def take(self, worth: Array) -> None:
        """From now on features are of another worth (K,)."""
        own = worth[self._which] * self._placed
        self._any, self._alike = own * self._lamp, np.sqrt(own) * self._lamp
        self._worth_of_missed = float(np.mean(own)) if len(own) else 0.0

    def log_ratio(self, poses: Array) -> Array:
        """(M, 2) log-likelihood of the view at poses (M, 3) over that at a wrong place: any, and one that is alike.

        What is missing is looked for only where what is there leaves a chance; it can only count against a pose.
        """
        return self._without_missed(self._features(poses), poses, self._missed)

    def _without_missed(self, score: Array, poses: Array, missed: Callable[[Array], Array]) -> Array:
        """(M, 2) log-likelihood ratios of scores (M, R) less what is missing at poses (M, 3), where that matters."""
        out = _mixed(score)
        whole = combined(out)
        near = np.flatnonzero(whole > np.max(whole, initial=-np.inf) - CLOSE)
        out[near] = _mixed(score[near] + missed(poses[near]))
        return out

    def unmapped(self, poses: Array, best: Array, grid: TypeGrid) -> Array:
        """(M,) share of what speaks for a pose (3,) that poses (M, 3) see on ground of which the map knows nothing."""
        speaks = self._speaks_for(best[None], grid)
        views = self._around.coverage.views(_moved(poses, self._view.xy_base_m), self._view.crossing_type)
        return np.asarray((1.0 - np.minimum(views / VIEWS, 1.0)) @ speaks / max(float(np.sum(speaks)), _TINY))

    def known(self, poses: Array) -> Array:
        """(M,) share of what is weighed that poses (M, 3) see on ground that the map knows."""
        at = _moved(poses, self._view.xy_base_m)
        return np.asarray(np.mean(self._around.coverage.knows(at, self._view.crossing_type), axis=1))

    def matches(self, poses: Array) -> Ints:
        """(M,) of what is weighed, how many poses (M, 3) see where a landmark of their type is."""
        bits = self._around.raster.at(_moved(poses, self._view.xy_base_m))
        return np.asarray(np.count_nonzero(is_in(bits, self._types[self._turns(poses)]), axis=1))

    def lacking(self, pose: Array) -> tuple[float, float]:
        """Rare features without any landmark on known ground, seen from a pose (3,), and how many are usual."""
        at, types = _moved(pose[None], self._view.xy_base_m)[0], self._types[self._turns(pose)]
        bits, views = self._around.raster.at(at), self._around.coverage.views(at, types)
        known = (views >= VIEWS) & (self._rare >> types.astype(np.uint16) & 1 > 0)
        nothing = known & ~is_in(bits, types) & (bits & RARE == 0)
        return float(np.count_nonzero(nothing)), float(np.sum(_unmapped(views[known])))

    def _speaks_for(self, pose: Array, grid: TypeGrid) -> Array:
        """(K,) by how much each feature makes a pose (1, 3) anywhere on the map likelier."""
        at, types = _moved(pose, self._view.xy_base_m), self._types[self._turns(pose)]
        matched, other = self._found_in(grid, at, types)
        views = self._around.coverage.views(at, types)
        each = kernel.each_of(self._ratios, views, types, matched, other, self._lines)
        return np.asarray(np.maximum(each[0, :, 0] * self._any, 0.0))

    @property
    def reach_m(self) -> float:
        return self._around.reach_m

    def log_ratio_in(self, grid: TypeGrid, poses: Array) -> Array:
        """(M, 2) the same for poses (M, 3) anywhere on the map."""
        score = np.empty((len(poses), 2 * len(CHANGED)))
        for part in np.array_split(np.arange(len(poses)), len(poses) // AT_ONCE + 1):
            at = _moved(poses[part], self._view.xy_base_m)
            types = self._types[self._turns(poses[part])]
            score[part] = self._scored(at, types, *self._found_in(grid, at, types))
        return self._without_missed(score, poses, partial(self._missed_in, grid))

    def _found_in(self, grid: TypeGrid, at: Array, types: Ints) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """(M, K) whether features of types (M, K) are where a landmark of theirs is, or another rare one."""
        bits = grid.bits(fine(at[..., 0]), fine(at[..., 1]))
        matched, other = is_in(bits, types), bits & self._rare > 0
        rare = np.nonzero(other & (self._rare >> types.astype(np.uint16) & 1 > 0))
        points, own, reach = (
            fine(at[rare]),
            np.left_shift(1, types[rare]).astype(np.uint16),
            int(fine(np.array(REACH_M))),
        )
        same, _ = grid.blocks.nearest(points, own, reach)
        matched[rare] = (same >= 0) & grid.blocks.named.take(same, mode="clip")
        other[rare] = matched[rare] | (grid.blocks.nearest(points, np.full(len(own), self._rare), reach)[0] >= 0)
        return matched, other

    def _turns(self, poses: Array) -> Ints:
        return np.asarray(np.round((self._view.heading_rad - poses[..., 2]) / _QUARTER).astype(np.int64) % 4)

    def _features(self, poses: Array) -> Array:
        """(M, R) of what is seen, for each fraction of change."""
        at, types = _moved(poses, self._view.xy_base_m), self._types[self._turns(poses)]
        bits = self._around.raster.at(at)
        return self._scored(at, types, is_in(bits, types), bits & RARE > 0)

    def _scored(self, at: Array, types: Ints, matched: NDArray[np.bool_], other: NDArray[np.bool_]) -> Array:
        """(M, R) of features (M, K) seen at (M, K, 2): whether a landmark of their type is there, or one beside."""
        views, worth = self._around.coverage.views(at, types), _by_kind(self._any, self._alike)
        score: Array = kernel.scored(self._ratios, views, types, matched, other, worth, self._lines)
        return score

    def _missed(self, poses: Array) -> Array:
        """(M, R) of landmarks that should be seen and are not."""
        landmarks = self._expected
        if not len(self._view.visible_m) or not len(landmarks):
            return np.zeros((len(poses), 2 * len(CHANGED)))
        kind = landmarks.crossing_type
        surprise = self._surprise(kind, landmarks.visibility, self._expected_lamp)
        own = np.left_shift(1, self._seen_as[:, kind]).astype(np.uint16)
        at, turns = landmarks.xy_map_m, self._turns(poses)
        score: Array = kernel.missed(
            self._raster.picture, poses, at, own, turns, int(VISIBLE), int(RARE), surprise, self._expected_lines
        )
        return score

    def _missed_in(self, grid: TypeGrid, poses: Array) -> Array:
        """(M, R) the same anywhere on the map."""
        out = np.zeros((len(poses), 2 * len(CHANGED)))
        if not len(self._view.visible_m) or not len(poses):
            return out
        blocks = grid.blocks
        reach = fine(np.max(np.hypot(*self._view.visible_m.T)))
        which, slot = blocks.pairs(fine(poses[:, :2]), int(reach))
        rare = np.flatnonzero(self._rare >> blocks.crossing_type.take(slot).astype(np.uint16) & 1)
        which, (slot, of) = which[rare], np.unique(slot[rare], return_inverse=True)
        xy, kind = (
            FINE_M * blocks.xy.take(slot, axis=0).astype(np.float64),
            blocks.crossing_type.take(slot).astype(np.int64),
        )
        surprise = self._surprise(kind, blocks.visibility.take(slot) / 255.0, of_lamp(xy, np.ones(len(xy), bool)))
        missed = np.flatnonzero(self._is_missed(poses[which], xy[of], kind[of]))
        of, which = of[missed], which[missed]
        most = np.ones(len(missed))
        for number in self._lines_of(xy, kind).T:
            lines = which * (int(number.max(initial=0)) + 1) + number[of]
            _, index, count = np.unique(lines, return_inverse=True, return_counts=True)
            np.maximum(most, count[index.reshape(-1)], out=most)
        np.add.at(out, which, surprise[of] * np.minimum(LINE_FEATURES / most, 1.0)[:, None])
        return out

    def _lines_of(self, xy_map_m: Array, kind: Ints) -> Ints:
        """(N, 2) numbers of the lines through landmarks (N, 2) of types (N,)."""
        return lines_through(xy_map_m, kind, self._around.axis_rad)

    def _is_missed(self, poses: Array, xy_map_m: Array, kind: Ints) -> NDArray[np.bool_]:
        """(...,) whether landmarks (..., 2) of types (...,) would be in view from poses (..., 3) and are not seen."""
        off = xy_map_m - poses[..., :2]
        c, s = np.cos(poses[..., 2]), np.sin(poses[..., 2])
        back = np.stack([c * off[..., 0] + s * off[..., 1], c * off[..., 1] - s * off[..., 0]], axis=-1)
        bits = self._raster.at(back)
        seen_as = self._seen_as[np.broadcast_to(self._turns(poses), kind.shape), kind]
        return np.asarray((bits & VISIBLE > 0) & ~is_in(bits, seen_as) & (bits & RARE == 0))

    def _surprise(self, kind: Ints, visibility: Array, lamp: Array) -> Array:
        """(N, R) log-likelihood ratios of landmarks of types (N,), worth (N,) of a lamp, not seen."""
        hit = np.minimum(visibility, MOST_VISIBLE)[:, None] * (1.0 - CHANGED)
        by_chance = self._around.chance.same[:, kind]
        each = [np.minimum(np.log((1.0 - hit) / (1.0 - q[:, None])), 0.0) for q in by_chance]
        worth = self._worth_of_missed
        return np.asarray(np.concatenate(each, axis=1) * _by_kind(worth * lamp, np.sqrt(worth) * lamp).T)


def _by_kind(any_: Array, alike: Array) -> Array:
    """(2 R, N) worths (N,) against either kind of wrong place, for every fraction of change."""
    return np.repeat(np.stack([any_, alike]), len(CHANGED), axis=0)


def _mixed(score: Array) -> Array:
    """(M, 2) over all fractions of change, of scores (M, 2 R)."""
    kinds = (INDEPENDENCE * score).reshape(-1, 2, len(CHANGED)) + np.log(CHANGED_CHANCE)
    return np.asarray(np.logaddexp.reduce(kinds, axis=2))


def _ratios(chance: Chance, least_unmapped: float, scale: float) -> Ratios:
    """Against any wrong place and against one like it, for every fraction of change."""
    return _ratios_of(chance.same.tobytes(), chance.rare_one.tobytes(), least_unmapped, scale)


def _unmapped(views: Array | Ints) -> Array:
    """Chance that a feature of a rare type is not in the map, on ground that was seen so often."""
    return np.asarray(1.0 / (UNMAPPED_FIRST + views / UNMAPPED_VIEWS))


@lru_cache(maxsize=4)
def _ratios_of(same: bytes, rare_one: bytes, least_unmapped: float, scale: float) -> Ratios:
    """The same of a chance's numbers: it is measured now and then, and asked in every view."""
    chance = Chance(*(np.frombuffer(v).reshape(2, -1) for v in (same, rare_one)))
    views = _VIEWS_PER_STEP * np.arange(256 // _VIEWS_PER_STEP)
    flickers = chance.rare | (np.arange(CROSSING_TYPES) >= LINE_CROSSINGS)
    unmapped = np.where(flickers, _unmapped(views[:, None]), UNMAPPED_COMMON)[..., None]
    unmapped = unmapped + (1.0 - unmapped) * CHANGED
    mistaken = TYPE_MISTAKEN[:, None]
    known = np.log(1.0 - unmapped)
    out: list[list[Array]] = [[], [], []]
    held = np.where(flickers[:, None], 1.0 - unmapped, 1.0)  # what the map lacks it lacks at wrong places, too
    for wrong in chance.seen_at_wrong_places:
        same, other = (np.log(p[:, None] * held) for p in wrong[:2])
        none = np.log(1.0 - (wrong[0] + wrong[1])[:, None] * held)
        out[0].append(known + np.log(1.0 - mistaken) - same)
        out[1].append(known + np.log(mistaken) - other)
        lacked = np.maximum(unmapped, np.minimum(scale * unmapped, UNMAPPED_MOST))
        out[2].append(np.minimum(np.log(np.maximum(lacked, least_unmapped)) - none, 0.0))
    rare = chance.rare[:, None]
    ratios = [np.concatenate(kinds, axis=2) for kinds in out]
    gain, mistaken = np.where(rare, ratios[0], np.minimum(ratios[0], 0.0)), np.where(rare, ratios[1], ratios[2])
    return Ratios(gain, mistaken, ratios[2], _VIEWS_PER_STEP, VIEWS)


def _moved(poses: Array, xy: Array) -> Array:
    """(M, K, 2) points (K, 2) in base, seen from poses (M, 3)."""
    c, s = np.cos(poses[:, 2:3]), np.sin(poses[:, 2:3])
    x, y = xy[:, 0], xy[:, 1]
    return np.stack([poses[:, :1] + c * x - s * y, poses[:, 1:2] + s * x + c * y], axis=-1)
