"""Poses that a view may be from, with what it explains, contradicts and misses there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceilvo.daemon.relocalisation.kernel.arguments import Fine
from ceilvo.daemon.relocalisation.place_index.blocks import FINE_M
from ceilvo.daemon.relocalisation.place_index.turned_views import TURNS
from ceilvo.types import Ints

CONTRADICTED = 4
"""Landmarks not seen that weigh as much as a feature where no landmark is. That one in ten is passed over makes
log(10) = 2.3 of each; that one feature in twenty is false, and then lies anywhere on 4 m^2 (association's outliers)
instead of within 2 cm, makes log(19 * 4 / (2 pi 0.02^2)) = 10 of it."""
EXPLAINED = 2 * CONTRADICTED
"""What the best place is chosen by: a feature on unmapped ground makes it worse by so much, one that it contradicts by
half as much again. Otherwise places at the map's rim would be best and make the limit too strict for all others."""
SAME_PLACE_M = 0.2
"""Side of the cells in which poses are one place: nearer than half of it always, never a tile of 0.3 m apart."""


@dataclass(slots=True)
class Found:
    """Verified poses: x, y, turn, explained, contradicted (M,), and missed (M,) once that is counted."""

    x: Fine
    y: Fine
    turn: Ints
    explained: Ints
    contradicted: Ints
    missed: Ints

    @staticmethod
    def at(x: Fine, y: Fine, turn: Ints) -> Found:
        """Nothing is counted yet."""
        return Found(x, y, turn, *np.zeros((3, len(x)), np.int64))

    @staticmethod
    def all_of(parts: Sequence[Found]) -> Found:
        none = np.empty(0, np.int32)
        parts = [Found.at(none, none, none.astype(np.int64)), *parts]
        return Found(*(np.concatenate([getattr(p, name) for p in parts]) for name in Found.__slots__))

    def of(self, which: Ints) -> Found:
        return Found(*(getattr(self, name).take(which) for name in self.__slots__))

    def __len__(self) -> int:
        return len(self.x)

    @property
    def cost(self) -> Ints:
        """What speaks against each."""
        return cost(self.contradicted, self.missed)

    @property
    def score(self) -> Ints:
        """What speaks for each, less what speaks against it."""
        return EXPLAINED * self.explained - self.cost


def cost(contradicted: Ints, missed: Ints) -> Ints:
    """Of features where no landmark is and landmarks that are not seen."""
    return CONTRADICTED * contradicted + missed


def first_of_places(f: Found) -> Ints:
    """Of poses of one heading that are in one cell of any of four grids, shifted by half a cell, the first one."""
    keep = np.arange(len(f))
    side = round(SAME_PLACE_M / FINE_M)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column = (f.x[keep].astype(np.int64) + dx * side // 2) // side
        row = (f.y[keep].astype(np.int64) + dy * side // 2) // side
        place = (column * (1 << 24) + row) * TURNS + f.turn[keep]
        keep = keep[np.sort(np.unique(place, return_index=True)[1])]
    return keep
