"""How often a wrong place of the same ceiling explains what is seen: measured on the map itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES, LINE_CROSSINGS, TYPE_MISTAKEN, commonest, turned_type
from ceilvo.daemon.relocalisation import kernel
from ceilvo.daemon.relocalisation.evidence.coverage import VIEWS, Coverage
from ceilvo.daemon.relocalisation.evidence.type_raster import RARE, TypeRaster
from ceilvo.se2 import rotation
from ceilvo.types import Array, Ints, Landmarks

COMMON = 0.8
"""A type that a wrong place explains more often than this proves no place; chosen."""
FEWEST_SAMPLES, ENOUGH = 8, 0.3
"""Landmarks, moved onto known ground, that it takes to measure how often chance explains them, and the same as a part
of all; chosen."""
UNMEASURED, UNMEASURED_COMMON = 0.5, 0.95
"""How often chance explains a feature where the map is too small to tell; the same of its commonest type, the joints
between tiles, which are wherever there are tiles. Chosen."""
LEAST, MOST = 0.02, 0.98
"""Nothing that was measured is believed beyond these; chosen: a map around the robot has some fifty of a kind."""
MOST_COMMON = 256
"""Landmarks of the commonest type that are asked; chosen for time: tiles of 0.3 m have 1600 within 6 m, 1250 shifts."""
NAMED = 0.95
"""Of what hangs at a place that is alike, how much has the same name; chosen. The map has some by other names, and
which those are differs from lamp to lamp: that told lamps on a raster apart that are alike."""
_NAMES = 3
"""Names that a rare crossing is mistaken for, about: four types are corners, four are edges on joints."""


@dataclass(frozen=True, slots=True)
class Chance:
    """How often a landmark, moved by whole tiles, finds another: on average, and by the most alike of the shifts.

    T is CROSSING_TYPES.

    Attributes:
        same: (2, T) one of its type.
        rare_one: (2, T) one of any rare type; never less than `same`.
    """

    same: Array
    rare_one: Array

    def __post_init__(self) -> None:
        """Recordings that are older than points have fewer types."""
        more = CROSSING_TYPES - self.same.shape[1]
        for name in ("same", "rare_one") if more > 0 else ():
            wider = np.concatenate([getattr(self, name), np.full((2, more), UNMEASURED)], axis=1)
            object.__setattr__(self, name, wider)

    @property
    def rare(self) -> NDArray[np.bool_]:
        """(T,) types that tell places apart."""
        return np.asarray(self.same[0] < COMMON)

    @property
    def seen_at_wrong_places(self) -> Array:
        """(2, 3, T) how often a feature is where a landmark of its type is, where one of another type is, and neither.

        Names are mistaken at wrong places as often as at the right one.
        """
        other, wrong = self.rare_one - self.same, TYPE_MISTAKEN / _NAMES
        same = self.same * (1.0 - TYPE_MISTAKEN) + other * wrong
        return np.stack([same, self.rare_one - same, 1.0 - self.rare_one], axis=1)

    @staticmethod
    def unmeasured(landmarks: Landmarks) -> Chance:
        """Of a map that is too small to tell."""
        same = np.full((2, CROSSING_TYPES), UNMEASURED)
        same[:, commonest(landmarks.crossing_type)] = UNMEASURED_COMMON
        return Chance(same, _between(same, same))

    @staticmethod
    def measured(
        landmarks: Landmarks,
        raster: TypeRaster,
        coverage: Coverage,
        shifts: Array,
        any_name: bool = False,
        about_m: Array | None = None,
    ) -> Chance:
        """By shifts (S, 2) of landmarks that are named.

        Args:
            any_name: what hangs there is alike whatever it is called.
            about_m: (2,) joint that they are turned about by quarters, too; None where tiles tell no joint.

        The most alike is chosen by all types but the commonest together, for the best of many is good by chance where a
        type has few landmarks; for the same reason such a type takes the rate of all.
        """
        if not len(shifts) or not len(landmarks):
            return Chance.unmeasured(landmarks)
        some = landmarks.of(_measured_by(landmarks.crossing_type))
        counts = [_tried(some.xy_map_m, some.crossing_type, raster, coverage, shifts)]
        some = some.of(some.crossing_type != commonest(landmarks.crossing_type))
        turns, middle_m = ((), np.zeros(2)) if about_m is None else ((1, 2, 3), about_m)
        for turn in turns:
            at = (some.xy_map_m - middle_m) @ rotation(turn * 0.5 * np.pi).T + middle_m
            kind, moved = turned_type(some.crossing_type, -turn), np.concatenate([shifts, np.zeros((1, 2))])
            counts.append(_tried(at, kind, raster, coverage, moved))
        tried, hits, anyone = np.concatenate(counts, axis=1)
        out, out_any = _rates(landmarks, tried, hits), _rates(landmarks, tried, anyone)
        if any_name:
            rare = np.arange(CROSSING_TYPES) != commonest(landmarks.crossing_type)
            out[1, rare] = np.maximum(out[1], NAMED * out_any[1])[rare]
        return Chance(out, _between(out, out_any))


def _tried(at: Array, kind: Ints, raster: TypeRaster, coverage: Coverage, shifts: Array) -> Array:
    """(3, S, T) landmarks at points (L, 2) that shifts (S, 2) move onto known ground, by the types (L,) they have
    there; those of them that find their like, and those that find any rare one."""
    out = np.zeros((3, len(shifts), CROSSING_TYPES))
    for points in (False, True):
        of = (kind >= LINE_CROSSINGS) == points
        if np.any(of):
            ground = coverage.of_kind(points).ground
            out += kernel.alike(raster.picture, ground, VIEWS, at[of], kind[of], shifts, CROSSING_TYPES, int(RARE))
    return out


def _measured_by(crossing_type: Ints) -> Ints:
    """Which landmarks of types (L,) chance is measured by: of the commonest no more than it takes."""
    common = crossing_type == commonest(crossing_type)
    usual = np.flatnonzero(common)
    few = usual[:: max(1, -(-len(usual) // MOST_COMMON))]
    return np.sort(np.concatenate([np.flatnonzero(~common), few]))


def _rates(landmarks: Landmarks, tried: Array, hits: Array) -> Array:
    """(2, T) shares of hits (S, T) in those that were tried (S, T): on average, and by the most alike shift."""
    kinds = np.bincount(landmarks.crossing_type, minlength=CROSSING_TYPES)
    common = int(np.argmax(kinds))
    rare = np.arange(CROSSING_TYPES) != common
    all_tried, all_hits = tried[:, rare].sum(axis=1), hits[:, rare].sum(axis=1)
    rate = (all_hits + 1.0) / (all_tried + 2.0)
    enough = all_tried >= max(FEWEST_SAMPLES, ENOUGH * float(kinds[rare].sum()))
    out = Chance.unmeasured(landmarks).same
    if np.any(enough):
        best = int(np.argmax(np.where(enough, rate, 0.0)))
        pooled = float(np.sum(all_hits[enough]) / np.sum(all_tried[enough]))
        out[0] = (hits[enough].sum(axis=0) + FEWEST_SAMPLES * pooled) / (tried[enough].sum(axis=0) + FEWEST_SAMPLES)
        out[1] = np.maximum((hits[best] + FEWEST_SAMPLES * rate[best]) / (tried[best] + FEWEST_SAMPLES), out[0])
    usual = (hits[:, common] + FEWEST_SAMPLES * UNMEASURED_COMMON) / (tried[:, common] + FEWEST_SAMPLES)
    out[:, common] = float(np.max(usual))
    return np.asarray(np.clip(out, LEAST, MOST))


def _between(same: Array, rare_one: Array) -> Array:
    """Chances of any rare one, above those of the same one and below 1."""
    return np.asarray(np.clip(rare_one, same + 0.5 * LEAST, 1.0 - 0.5 * LEAST))
