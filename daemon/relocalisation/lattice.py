"""On a periodic ceiling a pose whole tiles or quarter turns off sees nearly the same: which poses those are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import commonest, turned_type
from ceilvo.daemon.odometry.sight import SMALLEST_TILE_M
from ceilvo.se2 import compose, rotation, wrap, wrap_array
from ceilvo.types import Array, Ints, Landmarks, Observations

LARGEST_TILE_M = 3.0
"""Landmarks further apart say nothing of a period: beyond it few would be in one view."""
ALIGNED_M = 0.04
"""Two landmarks lie in one row of the lattice where they differ by less across it: a few sigmas of both."""
FEWEST_PAIRS = 4
"""Of fewer pairs no period is concluded; chosen."""
MOST_SHIFTS = 33
"""Tiles along a side of the square of shifts at most: 16 either way, 4.8 m of the smallest tiles."""
MOST_REPEATS, MOST_ASKED, REPEAT_M = 512, 128, 0.1
"""Displacements that repeat something, the most frequent ones; landmarks that they are taken from, and how far two may
differ that are one: a few sigmas. Chosen for time: 4 ms."""
WATCH_M, WATCH_TILES = 2.0, 3
"""How far those are looked for that a robot may have got to without a trace: three tiles, and no less than three of
0.6 m; chosen. A robot that was snatched away by two tiles of 1.25 m was never told by what it saw there."""
CELL_M, _CELLS = 0.05, 2
"""Places that are no more cells apart are one: 0.1 to 0.15 m, half the smallest tile at most."""
_QUARTER = 0.5 * np.pi


@dataclass(frozen=True, slots=True)
class Lattice:
    """Periods (2,) along the map's axes, 0 where there is none, the axes' direction, and what is periodic.

    Attributes:
        phase_m: (2,) where the landmarks of the commonest type lie in a tile, along the axes.
        crossing_type: that type.
    """

    tile_m: Array
    axis_rad: float
    phase_m: Array
    crossing_type: int

    @staticmethod
    def of(landmarks: Landmarks, axis_rad: float) -> Lattice | None:
        """None where the landmarks show no period along either axis."""
        if not len(landmarks):
            return None
        common = commonest(landmarks.crossing_type)
        at = landmarks.xy_map_m[landmarks.crossing_type == common] @ rotation(axis_rad)
        tile = np.array([_period(at), _period(at[:, ::-1])])
        if not np.any(tile):
            return None
        return Lattice(tile, axis_rad, _phase(at, tile), common)

    @property
    def watched_m(self) -> float:
        """How far rivals of a place that was sure are looked for."""
        return max(WATCH_M, WATCH_TILES * float(np.max(self.tile_m)))

    def reach_m(self, reach_m: float) -> float:
        """How far shifts within reach are listed along both axes."""
        return float(min(reach_m, *(MOST_SHIFTS // 2 * t for t in self.tile_m if t > 0)))

    def shifts(self, reach_m: float) -> Array:
        """(S, 2) all whole tiles within reach, none of them zero."""
        counts = [min(int(reach_m / t), MOST_SHIFTS // 2) if t > 0 else 0 for t in self.tile_m]
        i, j = np.meshgrid(*(np.arange(-n, n + 1) for n in counts), indexing="ij")
        steps = np.column_stack([i.ravel() * self.tile_m[0], j.ravel() * self.tile_m[1]])
        length = np.hypot(steps[:, 0], steps[:, 1])
        return np.asarray(steps[(length > 0) & (length <= reach_m)] @ rotation(self.axis_rad).T)

    def joint_near(self, xy_m: Array) -> Array:
        """(2,) the nearest node of the lattice to a point (2,) in map."""
        at = xy_m @ rotation(self.axis_rad)
        tile = np.where(self.tile_m > 0, self.tile_m, np.inf)
        steps = np.where(self.tile_m > 0, np.round((at - self.phase_m) / tile), 0.0)
        node = np.where(self.tile_m > 0, self.phase_m + steps * self.tile_m, at)
        return np.asarray(node @ rotation(self.axis_rad).T)

    def aligned(self, pose: Array, view: Observations, turn: int = 0) -> Array:
        """(3,) the nearest pose, so many quarter turns clockwise, from which what is seen lies on the lattice."""
        theta = wrap(view.heading_rad - turn * _QUARTER)
        there = np.array([pose[0], pose[1], theta])
        there[:2] += self._misfit(there, view, turn)
        return there

    def rivals(self, pose: Array, view: Observations, reach_m: float, turned: bool) -> Array:
        """(M, 3) rival_from_tracked: takes an aligned pose (3,) to each that sees the lattice as well, itself left out.

        Args:
            turned: also quarter turns about the robot.
        """
        shifts = self.shifts(reach_m)
        poses = [np.column_stack([pose[:2] + shifts, np.full(len(shifts), pose[2])])]
        for turn in (1, 2, 3) if turned else ():
            there = self.aligned(pose, view, turn)
            poses += [np.column_stack([there[:2] + shifts, np.full(len(shifts), there[2])]), there[None]]
        return rival_from_tracked(np.concatenate(poses), pose)

    def log_scales(self, view: Observations) -> tuple[Array, Array]:
        """Logarithms of each step in a row of what is seen over the period, (N,) and (M,) along the two axes."""
        seen = view.xy_base_m[view.crossing_type == self.crossing_type]
        at = seen @ rotation(view.heading_rad).T @ rotation(self.axis_rad)
        steps = (_steps(at), _steps(at[:, ::-1]))
        along, across = (np.log(s / t) if t > 0.0 else s[:0] for s, t in zip(steps, self.tile_m, strict=True))
        return along, across

    def _misfit(self, pose: Array, view: Observations, turn: int) -> Array:
        """(2,) in map, by how much a pose must move for what it sees of the lattice to lie on it."""
        seen = view.xy_base_m[turned_type(view.crossing_type, turn) == self.crossing_type]
        if not len(seen):
            return np.zeros(2)
        at = (seen @ rotation(float(pose[2])).T + pose[:2]) @ rotation(self.axis_rad)
        off, tile = self.phase_m - _phase(at, self.tile_m), np.where(self.tile_m > 0, self.tile_m, np.inf)
        off = np.where(self.tile_m > 0, off - np.round(off / tile) * self.tile_m, 0.0)
        return np.asarray(off @ rotation(self.axis_rad).T)


def rival_from_tracked(poses: Array, tracked: Array) -> Array:
    """(M, 3) transforms in map that take the tracked pose (3,) to poses (M, 3); they stay as the robot moves.

    They turn by whole quarters, as the lines say; a small angle times the distance to the origin would be large.
    """
    turn = np.round((poses[:, 2] - tracked[2]) / _QUARTER) * _QUARTER
    c, s = np.round(np.cos(turn)), np.round(np.sin(turn))
    x, y = tracked[:2]
    return np.column_stack([poses[:, 0] - (c * x - s * y), poses[:, 1] - (s * x + c * y), wrap_array(turn)])


def rival_poses(rivals: Array, tracked: Array) -> Array:
    """(M, 3) poses of rivals (M, 3) for a tracked pose (3,)."""
    out = np.asarray(compose(rivals, np.broadcast_to(tracked, rivals.shape)))
    out[:, 2] = wrap_array(out[:, 2])
    return out


def cells(places: Array, cell_m: float) -> Ints:
    """(N, 3) cells of transforms (N, 3) that turn by whole quarters: translations of one turn can be compared."""
    out: Ints = np.round(places / np.array([cell_m, cell_m, _QUARTER])).astype(np.int64)
    out[:, 2] %= 4
    return out


def beside(cell: list[int]) -> list[tuple[int, ...]]:
    """Cells of all transforms that are the same as one in this cell."""
    x, y, turn = cell
    return [(x + i, y + j, turn) for i in range(-_CELLS, _CELLS + 1) for j in range(-_CELLS, _CELLS + 1)]


def of_tracked(places: Array) -> NDArray[np.bool_]:
    """(N,) whether places (N, 3) are the tracked one, but for a few centimetres."""
    return np.asarray(same_places(places, np.zeros((1, 3)))[:, 0])


def same_places(a: Array, b: Array) -> NDArray[np.bool_]:
    """(N, M) whether transforms (N, 3) and (M, 3) are one."""
    apart = np.abs(cells(a, CELL_M)[:, None] - cells(b, CELL_M))
    return np.asarray(np.all(apart <= [_CELLS, _CELLS, 0], axis=2))


def offset(poses: Array, expected: Array) -> Array:
    """(..., 3) poses less an expected one (3,), in map."""
    out = np.array(poses - expected)
    out[..., 2] = wrap_array(out[..., 2])
    return out


def repeats(landmarks: Landmarks, reach_m: float) -> Array:
    """(S, 2) displacements in map that take a landmark but of the commonest type to another of its own within reach.

    Where there are no joints to tell a period by, lamps that hang in a pattern are found again so.
    """
    rare = np.flatnonzero(landmarks.crossing_type != commonest(landmarks.crossing_type))
    some = landmarks.of(rare[:: max(1, -(-len(rare) // MOST_ASKED))])
    same = some.crossing_type[:, None] == some.crossing_type
    step = (some.xy_map_m[None] - some.xy_map_m[:, None])[same]
    length = np.hypot(*step.T)
    step = step[(length > SMALLEST_TILE_M) & (length <= reach_m)]
    cell = np.round(step / REPEAT_M).astype(np.int64)
    _, first, count = np.unique(cell, axis=0, return_index=True, return_counts=True)
    return np.asarray(step[first[np.argsort(-count, kind="stable")[:MOST_REPEATS]]])


def _period(at: Array) -> float:
    """Median distance along the first axis from a landmark to the next in its row; 0 where there is none."""
    steps = _steps(at)
    return float(np.median(steps)) if len(steps) >= FEWEST_PAIRS else 0.0


def _steps(at: Array) -> Array:
    """(N,) distances along the first axis from points (M, 2) to the next in their row."""
    order = np.lexsort([at[:, 0], np.round(at[:, 1] / (2.0 * ALIGNED_M))])
    step = np.diff(at[order], axis=0)
    good = (np.abs(step[:, 1]) < ALIGNED_M) & (step[:, 0] > SMALLEST_TILE_M) & (step[:, 0] < LARGEST_TILE_M)
    return np.asarray(step[good, 0])


def _phase(at: Array, tile: Array) -> Array:
    """(2,) where most of these lie in a tile: the mean of the most that lie within ALIGNED_M.

    Diffusers within a tile have crossings like those of the tiles, and may have more of them in a view.
    """
    out = np.zeros(2)
    for k in range(2):
        if tile[k] > 0:
            sorted_m = np.sort(at[:, k] % tile[k])
            twice = np.concatenate([sorted_m, sorted_m + tile[k]])
            count = np.searchsorted(twice, sorted_m + ALIGNED_M, side="right") - np.arange(len(sorted_m))
            first = int(np.argmax(count))
            out[k] = np.mean(twice[first : first + count[first]])
    return out
