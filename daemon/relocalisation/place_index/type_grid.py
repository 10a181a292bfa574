"""Is there a landmark of a type at a point? Bits in square cells, in blocks where there are landmarks: O(1) a point."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import LINE_CROSSINGS, turned_type
from ceilvo.daemon.relocalisation.kernel.arguments import Fine
from ceilvo.daemon.relocalisation.place_index.blocks import (
    BLOCK_BITS,
    CELL_M,
    FINE_BITS,
    FINE_M,
    LandmarkBlocks,
    fine,
    grown,
)
from ceilvo.daemon.relocalisation.place_index.id_table import Slots
from ceilvo.types import Array, Ints, Landmarks, Observations

Bits = NDArray[np.uint16]

REACH_M = 0.15
"""About the association gate."""
GROUND_M = 0.45
"""Ground is mapped so near a landmark: less than a tile, so that a missing neighbour shows."""
HALF_DIAGONAL_M = CELL_M * np.sqrt(0.5)
"""A cell's bit holds for its centre: a point within REACH_M less this of a landmark finds it always, one beyond REACH_M
and this never."""
GROUND = np.uint16(1 << LINE_CROSSINGS)
"""The bit between those of crossings and of points, which no type has: ground is mapped here."""
IN_BLOCK = (1 << BLOCK_BITS) - 1
CELLS = 1 << 2 * BLOCK_BITS
"""Of a block."""
CHUNK, DRAWN = 1 << 14, 1 << 10
"""Points looked up and landmarks drawn at once, so that their arrays stay in the cache; chosen."""


@dataclass(slots=True)
class TypeGrid:
    """Landmarks drawn into cells.

    Attributes:
        reach_m: bit t is set in cells whose centre is so near a landmark of type t; GROUND within GROUND_M.
        blocks: the landmarks.
        cells: (B * 256,) bits of the cells, block by block; block 0 is where nothing is.
    """

    reach_m: float = REACH_M
    blocks: LandmarkBlocks = field(default_factory=LandmarkBlocks)
    cells: Bits = field(default_factory=lambda: np.zeros(CELLS, np.uint16))

    def __post_init__(self) -> None:
        if not 0.0 < self.reach_m <= GROUND_M:
            raise ValueError(f"reach_m is {self.reach_m}; expected a reach above 0 and up to {GROUND_M} m")

    @staticmethod
    def of(landmarks: Landmarks, reach_m: float = REACH_M) -> TypeGrid:
        grid = TypeGrid(reach_m)
        grid.add(landmarks)
        return grid

    def __len__(self) -> int:
        return len(self.blocks)

    def add(self, landmarks: Landmarks) -> Slots:
        """Draw landmarks with ids that are not there yet; their slots, which stay until they are removed."""
        slots = self.blocks.add(landmarks, _fine(GROUND_M + CELL_M))
        self.cells = grown(self.cells, self.blocks.directory.count * CELLS)
        self._draw(slots)
        return slots

    def remove(self, slots: Slots) -> None:
        """Take out landmarks by their slots, each once, and draw their neighbours again."""
        if not len(slots):
            return
        gone = self.blocks.xy[slots]
        self.blocks.remove(slots)
        for part in np.array_split(gone, len(gone) // DRAWN + 1):
            self.cells[self._stamps(part, np.zeros(len(part), np.int64))[0]] = 0
        self._draw(self._around(gone))

    def replace(self, landmarks: Landmarks) -> None:
        """Another map."""
        fresh = TypeGrid.of(landmarks, self.reach_m)
        self.blocks, self.cells = fresh.blocks, fresh.cells

    def bits(self, x: Fine, y: Fine) -> Bits:
        """(Q,) of the cells in which points lie."""
        return self.cells.take(self._addresses(x, y))

    def hits(self, poses: Array, view: Observations) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """For poses (M, 3) and the K features of a view, their types turned into the quadrant of each pose's heading.

        Returns:
            (M, K) whether a landmark of its type is where a feature is, and (M, K) whether ground is mapped there.
        """
        there = np.empty((len(poses), len(view)), bool)
        ground = np.empty((len(poses), len(view)), bool)
        own = np.array([np.left_shift(1, turned_type(view.crossing_type, t)) for t in range(4)], np.uint16)
        at_once = max(CHUNK // max(len(view), 1), 1)
        for begin in range(0, len(poses), at_once):
            part = slice(begin, begin + at_once)
            bits = self._bits_seen(poses[part], view.xy_base_m)
            there[part] = bits & own[turns_to(view, poses[part, 2])]
            ground[part] = bits & GROUND
        return there, ground

    def _bits_seen(self, poses: Array, xy_base_m: Array) -> Bits:
        """(M, K) bits at points of base."""
        c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
        x, y = xy_base_m.T
        return self.bits(fine(poses[:, :1] + c * x - s * y), fine(poses[:, 1:2] + s * x + c * y))

    @property
    def nbytes(self) -> int:
        return self.cells.nbytes + self.blocks.nbytes

    def _draw(self, slots: Slots) -> None:
        for part in np.array_split(slots, len(slots) // DRAWN + 1):
            at, bits = self._stamps(self.blocks.xy[part], self.blocks.crossing_type[part].astype(np.int64))
            np.bitwise_or.at(self.cells, at, bits)

    def _stamps(self, xy: Fine, kind: NDArray[np.integer]) -> tuple[Fine, Bits]:
        """Cells that landmarks reach, and the bits that they set there."""
        x, y, own, near = reached(xy, kind, self.reach_m, GROUND_M)
        return self._addresses(x, y), np.where(near, own | GROUND, GROUND).astype(np.uint16)

    def _addresses(self, x: Fine, y: Fine) -> NDArray[np.int32]:
        """Of the cells of points."""
        at = self.blocks.directory.at(x, y)
        at <<= 2 * BLOCK_BITS
        at |= (x >> (FINE_BITS - BLOCK_BITS)) & (IN_BLOCK << BLOCK_BITS)
        at |= (y >> FINE_BITS) & IN_BLOCK
        return at

    def _around(self, xy: Fine) -> Slots:
        """Landmarks whose cells may be those of landmarks at these points."""
        return self.blocks.near(xy, _fine(2.0 * GROUND_M + CELL_M))


def reached(
    xy: Fine, kind: NDArray[np.integer], reach_m: float, furthest_m: float
) -> tuple[Fine, Fine, Bits, NDArray[np.bool_]]:
    """Centres (N,), (N,) of all cells within `furthest_m` of points, the bit of the point's type, whether in reach."""
    cells = int(np.ceil(furthest_m / CELL_M))
    offset = np.arange(-cells, cells + 1, dtype=np.int32) << FINE_BITS
    centre = ((xy >> FINE_BITS) << FINE_BITS) + np.int32(1 << (FINE_BITS - 1))
    dx, dy = ((centre[:, i] - xy[:, i])[:, None] + offset for i in (0, 1))
    apart2 = dx[:, :, None] ** 2 + dy[:, None, :] ** 2
    which, i, j = np.nonzero(apart2 <= _fine(furthest_m) ** 2)
    own = np.left_shift(1, kind).astype(np.uint16)[which]
    return centre[which, 0] + offset[i], centre[which, 1] + offset[j], own, apart2[which, i, j] <= _fine(reach_m) ** 2


def turns_to(view: Observations, heading_rad: Array) -> Ints:
    """(M,) by how many quarter turns the types of a view must be named further where the robot's heading is (M,)."""
    if not np.isfinite(view.heading_var_rad2):
        return np.zeros(len(heading_rad), np.int64)
    return np.asarray(np.round((view.heading_rad - heading_rad) / (0.5 * np.pi)), np.int64) % 4


def _fine(length_m: float) -> int:
    return round(length_m / FINE_M)
