"""The place index: from one view to the places of a map that it can be from."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation.place_index.blocks import fine, visible_255
from ceilvo.daemon.relocalisation.place_index.false_alarm import false_alarm_probability
from ceilvo.daemon.relocalisation.place_index.found import CONTRADICTED, cost
from ceilvo.daemon.relocalisation.place_index.id_table import Slots
from ceilvo.daemon.relocalisation.place_index.members import Members
from ceilvo.daemon.relocalisation.place_index.names import SEEN_255, name_again, same_corner
from ceilvo.daemon.relocalisation.place_index.refinement import refined
from ceilvo.daemon.relocalisation.place_index.search import Search
from ceilvo.daemon.relocalisation.place_index.type_grid import REACH_M, TypeGrid
from ceilvo.types import Array, Ints, Landmarks, Observations

MOST = 16_384
"""Candidates that are kept; a building of 15,000 m^2 has about 7,000 lamps, half of them at the right quarter turn."""
MARGIN = 3 * CONTRADICTED
"""Cost that a candidate may have beyond the best one's; three features that are false have a chance of 1e-4 if one in
twenty is."""
MOVED_M = 0.02
"""A landmark that moved by less stays where it was indexed: less than a feature's noise."""


@dataclass(frozen=True, slots=True)
class Candidates:
    """Places that a view can be from, the best first.

    A place costs 4 for a feature that it contradicts and 1 for a landmark missed; the best has the highest score, 8 for
    a feature that it explains less that cost.

    Attributes:
        pose: (M, 3) map_from_base, within a few centimetres; see PlaceIndex.refined.
        explained: (M,) features with a landmark of their type.
        contradicted: (M,) features without one on mapped ground; the rest is on unmapped ground and says nothing.
        missed: (M,) landmarks that should be seen and are not; 0 where the view does not say what is visible.
        seen: features that were looked at: all of the view, or the 64 with the fewest landmarks of their type.
        floor: every place that explains at least so many features was looked at; above `seen` where none was.
        limit: cost up to which places are listed, that of the best and the margin.
        complete: every place that costs at most `limit` is listed, except those that lie partly on unmapped ground and
            explain less than `floor` features.
        false_alarm_probability: (M,) chance that somewhere on a map like this a wrong place explains as many features.
    """

    pose: Array
    explained: Ints
    contradicted: Ints
    missed: Ints
    seen: int
    floor: int
    limit: float
    complete: bool
    false_alarm_probability: Array

    def __len__(self) -> int:
        return len(self.pose)

    @property
    def cost(self) -> Ints:
        """(M,)."""
        return cost(self.contradicted, self.missed)


@dataclass(slots=True)
class PlaceIndex:
    """Landmarks that can be looked up by what is around them; it grows and changes with its map.

    Attributes:
        grid: which types are where.
        members: landmarks by type.
    """

    grid: TypeGrid = field(default_factory=TypeGrid)
    members: Members = field(default_factory=Members)

    @staticmethod
    def of(landmarks: Landmarks, reach_m: float = REACH_M) -> PlaceIndex:
        index = PlaceIndex(TypeGrid(reach_m))
        index.add(landmarks)
        return index

    def __len__(self) -> int:
        return len(self.grid)

    @property
    def ids(self) -> Ints:
        """(L,) of the landmarks that are indexed, in no order."""
        return np.asarray(self.grid.blocks.ids[self.grid.blocks.live], np.int64)

    def within(self, low_m: Array, high_m: Array) -> Ints:
        """(N,) ids of the landmarks in a box between two corners (2,)."""
        blocks = self.grid.blocks
        slots = blocks.near(fine(0.5 * (low_m + high_m))[None], int(np.max(fine(high_m - low_m))) // 2)
        inside = np.all((blocks.xy[slots] >= fine(low_m)) & (blocks.xy[slots] <= fine(high_m)), axis=1)
        return np.asarray(blocks.ids[slots[inside]], np.int64)

    def sync(self, landmarks: Landmarks, moved_m: float = MOVED_M) -> None:
        """Bring the index up to date with these landmarks, a part of the map: new ones, moved ones, other types."""
        blocks = self.grid.blocks
        slots = blocks.find(landmarks.ids)
        known = np.flatnonzero(slots >= 0)
        at, was = fine(landmarks.xy_map_m[known]), blocks.xy[slots[known]]
        off = np.hypot(*(at.astype(np.int64) - was).T)
        other = blocks.crossing_type[slots[known]] != landmarks.crossing_type[known]
        changed = known[(off > fine(np.array(moved_m))) | other]
        self._see(slots[known], visible_255(landmarks.of(known)))
        self._remove(slots[changed])
        fresh = slots < 0
        fresh[changed] = True
        if np.any(fresh):
            self.add(landmarks.of(fresh))

    def _see(self, slots: Slots, visibility: NDArray[np.uint8]) -> None:
        """Take in how visible landmarks are now, where that has changed."""
        blocks = self.grid.blocks
        changed = np.abs(visibility.astype(np.int64) - blocks.visibility[slots]) > SEEN_255
        blocks.visibility[slots[changed]] = visibility[changed]
        name_again(blocks, slots[changed])

    def named(self, ids: Ints) -> NDArray[np.bool_]:
        """(N,) whether landmarks are not mistaken names of others; those that are not there are not."""
        slots = self.grid.blocks.find(ids)
        named = slots < 0
        named[~named] = self.grid.blocks.named[slots[~named]]
        return np.asarray(named, np.bool_)

    def add(self, landmarks: Landmarks) -> None:
        """Landmarks with ids that are not there yet, each once."""
        slots = self.grid.add(landmarks)
        name_again(self.grid.blocks, slots)
        self.members.add(slots, self.grid.blocks.crossing_type[slots].astype(np.int64))

    def remove(self, ids: Ints) -> None:
        """Take landmarks out by their ids; those that are not there are passed over."""
        slots = np.unique(self.grid.blocks.find(ids))
        self._remove(slots[slots >= 0])

    def _remove(self, slots: Slots) -> None:
        if not len(slots):
            return
        beside = same_corner(self.grid.blocks, slots)
        self.members.remove(slots, self.grid.blocks.crossing_type[slots].astype(np.int64))
        self.grid.remove(slots)
        name_again(self.grid.blocks, np.setdiff1d(beside, slots))

    def candidates(self, view: Observations, margin: float = MARGIN, most: int = MOST) -> Candidates:
        """The places that a view can be from.

        Args:
            view: its labels are not looked at; only heading_rad modulo 90 deg is.
            margin: cost that a place may have beyond the best one's to be listed, for up to 32 features; in proportion
                more for more.
            most: places listed.
        """
        search = Search.of(self.grid, self.members, view, margin)
        search.run()
        found = search.kept()
        kept = found.of(np.arange(min(len(found), most)))
        whole = len(kept) == len(found) and not self.grid.blocks.left_out
        return Candidates(
            pose=search.poses(kept),
            explained=kept.explained,
            contradicted=kept.contradicted,
            missed=kept.missed,
            seen=len(search.order),
            floor=search.floor,
            limit=search.limit,
            complete=whole and search.complete,
            false_alarm_probability=false_alarm_probability(search, kept.explained),
        )

    def counts(self, poses: Array, view: Observations) -> tuple[Ints, Ints, Ints]:
        """(M,) explained, contradicted and missed as in Candidates, at poses (M, 3) along the view's lines."""
        counted = Search.of(self.grid, self.members, view, 0.0).counted(poses)
        return counted.explained, counted.contradicted, counted.missed

    def refined(self, poses: Array, view: Observations) -> Array:
        """(M, 3) poses moved by the mean residual to the landmarks of the features' types within reach."""
        return refined(self.grid, poses, view)

    @property
    def nbytes(self) -> int:
        return self.grid.nbytes + self.members.nbytes
