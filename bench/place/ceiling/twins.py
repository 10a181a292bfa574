"""From when on a place can be told at all: where else on a ceiling everything that was passed looks the same.

A bound for whoever looks for the place: an eye that finds every crossing of the ceiling with its type, in a disc of the
picture's area, and knows the whole map cannot tell two places apart before one of these crossings differs.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ceilvo.bench.place.ceiling.truth import Features
from ceilvo.calibration import Calibration, visible_polygon
from ceilvo.config import Features as Settings
from ceilvo.crossing_types import turned_type
from ceilvo.se2 import rotation, transform
from ceilvo.types import Array, Ints, Pose

_SAME_M = 0.05
"""A crossing so near another one of its type is as good as there; chosen: a quarter of the association gate."""
_APART_M = 0.25
"""The ceiling is looked at again after so much of the way; chosen: a tenth of the disc."""
_TURNS = 4


class Twins:
    """Places that look like the robot's own, along its way."""

    def __init__(
        self, features: Features, known: NDArray[np.bool_], calibration: Calibration, within_m: float = np.inf
    ) -> None:
        """known: (N,) crossings of the map; within_m: so far from where it is the robot can be at most."""
        self._xy, self._kind = features.xy_map_m[known], features.crossing_type[known]
        self._all = cKDTree(self._xy)
        self._of = {int(kind): np.flatnonzero(self._kind == kind) for kind in np.unique(self._kind)}
        self._trees = {kind: cKDTree(self._xy[which]) for kind, which in self._of.items()}
        corners = visible_polygon(calibration, 0.0, Settings().max_view_deg)
        area_m2 = abs(float(cv2.contourArea(corners.astype(np.float32))))
        self._radius_m, self._middle_m = float(np.sqrt(area_m2 / np.pi)), corners.mean(axis=0)
        self._within_m = within_m
        self._from: Array | None = None
        self._last: Array | None = None
        self._seen = np.zeros(0, np.int64)
        self._turn, self._to = np.zeros(0, np.int64), np.zeros((0, 2))

    def passed(self, pose: Array) -> int | None:
        """Places that explain all that was passed up to a true pose (3,), the robot's own among them; None before
        anything was."""
        at = transform(Pose(pose), self._middle_m[None])[0]
        if self._last is None or float(np.hypot(*(at - self._last))) >= _APART_M:
            self._look(at)
        return None if self._from is None else len(self._to)

    def _look(self, at: Array) -> None:
        here = np.array(self._all.query_ball_point(at, self._radius_m), np.int64)
        if not len(here):
            return
        self._last = at
        new = sorted(np.setdiff1d(here, self._seen).tolist(), key=lambda i: len(self._of[int(self._kind[i])]))
        self._seen = np.union1d(self._seen, here)
        if self._from is None:
            self._from = at
            self._begin(new[0])
        for i in new:
            self._keep(self._has(i))
        self._keep(self._as_many(at))

    def _begin(self, rarest: int) -> None:
        """Every landmark that may be the rarest of those that are seen."""
        assert self._from is not None
        turns, to = [], []
        for turn in range(_TURNS):
            which = self._of.get(int(_type_turned(self._kind[rarest], turn)), np.zeros(0, np.int64))
            to.append(self._xy[which] - _turned(self._xy[rarest] - self._from, turn))
            turns.append(np.full(len(which), turn))
        self._turn, self._to = np.concatenate(turns), np.concatenate(to)
        self._keep(np.hypot(*(self._to - self._from).T) <= self._within_m)

    def _keep(self, which: NDArray[np.bool_]) -> None:
        self._turn, self._to = self._turn[which], self._to[which]

    def _moved(self, xy: Array, turn: int) -> Array:
        """(C, 2) where a point (2,) lies for the places of a turn."""
        assert self._from is not None
        return np.asarray(self._to[self._turn == turn] + _turned(xy - self._from, turn))

    def _has(self, i: int) -> NDArray[np.bool_]:
        """(C,) whether a place has what is seen."""
        out = np.zeros(len(self._to), bool)
        for turn in range(_TURNS):
            tree = self._trees.get(int(_type_turned(self._kind[i], turn)))
            if tree is not None:
                away = tree.query(self._moved(self._xy[i], turn), distance_upper_bound=_SAME_M)[0]
                out[self._turn == turn] = np.isfinite(away)
        return out

    def _as_many(self, at: Array) -> NDArray[np.bool_]:
        """(C,) whether a place has no more than is seen around a point (2,), but for the disc's edge."""
        most = len(self._all.query_ball_point(at, self._radius_m + _SAME_M))
        out = np.zeros(len(self._to), bool)
        for turn in range(_TURNS):
            moved = self._moved(at, turn)
            if len(moved):
                inside = self._all.query_ball_point(moved, self._radius_m, return_length=True)
                out[self._turn == turn] = inside <= most
        return out


def _turned(xy: Array, turn: int) -> Array:
    return np.asarray(rotation(0.5 * np.pi * turn) @ xy)


def _type_turned(kind: Ints, turn: int) -> Ints:
    """The type of a crossing of a ceiling that is turned by so many quarters."""
    return turned_type(np.asarray(kind), -turn)
