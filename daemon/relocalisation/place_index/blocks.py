"""Landmarks in square blocks of cells: which are near a point, with slots that stay while landmarks come and go.

Positions are whole numbers of 1/256 of a cell (FINE), so that the cell and the block of a point are shifts of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation import kernel
from ceilvo.daemon.relocalisation.kernel.arguments import END, Chains, Fine
from ceilvo.daemon.relocalisation.kernel.reference import walk
from ceilvo.daemon.relocalisation.place_index.id_table import IdTable, Slots
from ceilvo.types import Array, Ints, Landmarks

_T = TypeVar("_T", bound=np.generic)
CELL_M = 0.1
"""Side of a cell; two thirds of the association gate of 0.15 m. Memory grows with its inverse square."""
FINE_BITS, BLOCK_BITS = 8, 4
"""A position is 0.4 mm fine, a tenth of a feature's noise; a block is 16 x 16 cells, 1.6 m: 512 bytes of TypeGrid."""
FINE_M = CELL_M / (1 << FINE_BITS)
BLOCK_SHIFT = FINE_BITS + BLOCK_BITS
BLOCK_M = CELL_M * (1 << BLOCK_BITS)
MOST_BLOCKS = 1 << 24
"""Of the rectangle around the map, 64 MB: 6.5 km x 6.5 km. What lies further out is not indexed."""
FURTHEST_M = 100_000.0
"""No coordinate beyond this is indexed; the numbers of FINE end at 838 km."""
MARGIN = 8
"""Blocks that the rectangle grows by beyond what is needed, so that a map in the making seldom makes it grow."""
BORN_BY = 3
"""Sightings that make a landmark, filter.birth_sightings as it is by default."""
GROWTH = 1.2
"""Arrays that are full grow by this factor."""


def fine(xy_m: Array) -> Fine:
    """Coordinates of any shape from metres; what lies beyond FURTHEST_M is put there."""
    return np.asarray(np.round(np.clip(xy_m, -FURTHEST_M, FURTHEST_M) / FINE_M), np.int32)


def grown(a: NDArray[_T], size: int, fill: int = 0) -> NDArray[_T]:
    """The array with at least `size` rows."""
    if size <= len(a):
        return a
    out = np.full((max(size, int(GROWTH * len(a))), *a.shape[1:]), fill, a.dtype)
    out[: len(a)] = a
    return out


@dataclass(slots=True)
class BlockDirectory:
    """Numbers of the blocks that there are, by their place; 0 where there is none.

    Attributes:
        origin: (2,) place of number[0, 0] in blocks.
        number: (W, H) with a rim of zeros.
        count: numbers given out, 0 included.
    """

    origin: Ints = field(default_factory=lambda: np.zeros(2, np.int64))
    number: NDArray[np.int32] = field(default_factory=lambda: np.zeros((2, 2), np.int32))
    count: int = 1

    def at(self, x: Fine, y: Fine) -> NDArray[np.int32]:
        """Numbers of the blocks in which points lie."""
        w, h = self.number.shape
        column, row = x >> BLOCK_SHIFT, y >> BLOCK_SHIFT
        for places, first, size in ((column, self.origin[0], w), (row, self.origin[1], h)):
            places -= np.int32(first)
            np.maximum(places, 0, out=places)
            np.minimum(places, np.int32(size - 1), out=places)
        column *= np.int32(h)
        column += row
        return self.number.ravel().take(column)

    def ensure(self, places: Fine) -> None:
        """Give numbers to the blocks at these places (N, 2), in blocks, that have none; they must fit()."""
        if not len(places):
            return
        self._cover(places.min(axis=0).astype(np.int64), places.max(axis=0).astype(np.int64))
        flat = self.number.reshape(-1)
        off = places - self.origin
        at = np.unique(off[:, 0] * self.number.shape[1] + off[:, 1])
        fresh = at[flat[at] == 0]
        flat[fresh] = self.count + np.arange(len(fresh))
        self.count += len(fresh)

    def fits(self, places: Fine) -> NDArray[np.bool_]:
        """Which of these places (N, 2), in blocks, can be covered with what there is and with those before them."""
        at = places.astype(np.int64)
        low, high = self._bounds() if self.count > 1 else (at[0], at[0])
        if _blocks(np.minimum(low, at.min(axis=0)), np.maximum(high, at.max(axis=0))) <= MOST_BLOCKS:
            return np.ones(len(at), bool)
        inside = np.zeros(len(at), bool)
        for i, place in enumerate(at):
            lower, higher = np.minimum(low, place), np.maximum(high, place)
            if _blocks(lower, higher) <= MOST_BLOCKS:
                low, high, inside[i] = lower, higher, True
        return inside

    def _bounds(self) -> tuple[Ints, Ints]:
        return self.origin + 1, self.origin + np.array(self.number.shape) - 2

    def _cover(self, low: Ints, high: Ints) -> None:
        if self.count > 1:
            least, most = self._bounds()
            if np.all(low >= least) and np.all(high <= most):
                return
            low = np.where(low < least, low - MARGIN, least)
            high = np.where(high > most, high + MARGIN, most)
        old, origin = self.number, low - 1
        number = np.zeros(tuple(high - low + 3), np.int32)
        if self.count > 1:
            x, y = self.origin - origin
            number[x : x + old.shape[0], y : y + old.shape[1]] = old
        self.number, self.origin = number, origin


def _blocks(low: Ints, high: Ints) -> float:
    """Of the rectangle that covers from low to high (2,), after it has grown on all sides."""
    return float(np.prod(high - low + 2.0 * MARGIN + 3.0))


@dataclass(slots=True)
class LandmarkBlocks:
    """Landmarks by slot, and in each block a chain of those that lie in it.

    Attributes:
        directory: the blocks.
        head: (B,) first slot of a block's chain, END for none.
        chain: (S,) the slot after this one in its block, END after the last.
        ids, xy, crossing_type: (S,) id, (S, 2) position, type; a free slot has the type END.
        visibility: (S,) chance that a view shows a landmark that is in it, in 1/255.
        named: (S,) whether a landmark is not a mistaken name of another one, see names.py.
        free: (F,) free slots, the first `freed` of them.
        table: from ids to slots.
        length: slots that were ever in use.
        left_out: landmarks that lie too far out to be indexed, since the index was made.
    """

    directory: BlockDirectory = field(default_factory=BlockDirectory)
    head: Slots = field(default_factory=lambda: np.full(1, END, np.int32))
    chain: Slots = field(default_factory=lambda: np.empty(0, np.int32))
    ids: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    xy: Fine = field(default_factory=lambda: np.empty((0, 2), np.int32))
    crossing_type: NDArray[np.int8] = field(default_factory=lambda: np.empty(0, np.int8))
    visibility: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    named: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))
    free: Slots = field(default_factory=lambda: np.empty(0, np.int32))
    freed: int = 0
    table: IdTable = field(default_factory=IdTable)
    length: int = 0
    left_out: int = 0

    def __post_init__(self) -> None:
        """ValueError for chains of a file that lead nowhere, or round and round."""
        if not len(self.ids):
            return
        sizes = {len(a) for a in (self.chain, self.ids, self.xy, self.crossing_type, self.visibility, self.named)}
        counts = 0 <= self.freed <= len(self.free) and 0 < self.length <= len(self.ids)
        if sizes != {len(self.ids)} or not counts or self.directory.count > len(self.head):
            raise ValueError(f"columns of {sorted(sizes)} landmarks, {self.length} in use, expected as many in each")
        live = self.live
        after = np.concatenate([self.head, self.chain[live]])
        if not np.array_equal(np.sort(after[after != END]), live):
            raise ValueError(f"chains of {np.count_nonzero(after != END)} landmarks, expected each of {len(live)} once")
        numbers = np.arange(len(self.head), dtype=np.int32)
        for which, slot in self.walk(numbers):
            if not np.array_equal(self.directory.at(*self.xy[slot].T), numbers[which]):
                raise ValueError("a landmark in the chain of another block")

    def __len__(self) -> int:
        return self.length - self.freed

    @property
    def live(self) -> Slots:
        """Slots in use, in order."""
        return np.flatnonzero(self.crossing_type[: self.length] != END).astype(np.int32)

    def find(self, ids: Ints) -> Slots:
        """(N,) slots, -1 for ids that are not there."""
        return self.table.find(ids, self.ids)

    def add(self, landmarks: Landmarks, around: int) -> Slots:
        """Take in landmarks with new ids; blocks that lie within `around` of them exist from then on. Their slots."""
        if not len(landmarks):
            return np.empty(0, np.int32)
        xy = fine(landmarks.xy_map_m)
        inside = np.all(np.abs(landmarks.xy_map_m) < FURTHEST_M, axis=1)
        inside &= self.directory.fits(xy >> BLOCK_SHIFT)
        self.left_out += int(np.count_nonzero(~inside))
        self.directory.ensure(_touched(xy[inside], around))
        self.head = grown(self.head, self.directory.count, END)
        slots = self._take_slots(int(np.count_nonzero(inside)))
        self.ids[slots], self.xy[slots] = landmarks.ids[inside], xy[inside]
        self.crossing_type[slots] = landmarks.crossing_type[inside]
        self.visibility[slots] = visible_255(landmarks.of(inside))
        self.named[slots] = True
        self.table.insert(self.ids[slots], slots, self.ids)
        self._link(slots)
        return slots

    def remove(self, slots: Slots) -> None:
        """Take out landmarks by their slots, each once."""
        self.table.remove(self.ids[slots], self.ids)
        for slot, block in zip(slots.tolist(), self.directory.at(*self.xy[slots].T).tolist(), strict=True):
            self._unlink(slot, block)
        self.crossing_type[slots] = END
        self.free = grown(self.free, self.freed + len(slots))
        self.free[self.freed : self.freed + len(slots)] = slots
        self.freed += len(slots)

    def walk(self, blocks: NDArray[np.int32]) -> Iterator[tuple[Ints, Slots]]:
        """All landmarks in blocks (Q,), in parts: which of the blocks, and a slot in it."""
        return walk(self.head, self.chain, blocks)

    def own_bit(self, slots: Slots) -> NDArray[np.uint16]:
        """(N,) with the bit of each landmark's type."""
        return np.asarray(np.left_shift(np.uint16(1), self.crossing_type.take(slots).astype(np.uint16)), np.uint16)

    def near(self, xy: Fine, reach: int) -> Slots:
        """Slots, in order, of all landmarks within reach, along both axes, of any of the points (Q, 2)."""
        return np.unique(self.pairs(xy, reach)[1])

    def pairs(self, xy: Fine, reach: int) -> tuple[Ints, Slots]:
        """All pairs of a point (Q, 2) and the slot of a landmark within reach of it along both axes, in any order."""
        which, slots = kernel.pairs(self._chains(), xy, reach)
        return which, slots

    def nearest(self, xy: Fine, wanted: NDArray[np.uint16], reach: int) -> tuple[Slots, NDArray[np.float64]]:
        """For each point (Q, 2) the slot of the nearest landmark of the types whose bits (Q,) are set, or -1, and its
        distance in FINE."""
        slots, apart = kernel.nearest(self._chains(), xy, wanted, reach)
        return slots, apart

    def _chains(self) -> Chains:
        d = self.directory
        return Chains(d.origin, d.number, self.head, self.chain, self.xy, self.crossing_type, BLOCK_SHIFT)

    @property
    def nbytes(self) -> int:
        arrays = (self.head, self.chain, self.ids, self.xy, self.crossing_type, self.visibility, self.named, self.free)
        return sum(a.nbytes for a in (*arrays, self.table.slot, self.directory.number))

    def _take_slots(self, count: int) -> Slots:
        again = min(count, self.freed)
        self.freed -= again
        slots = np.concatenate([self.free[self.freed : self.freed + again], self.length + np.arange(count - again)])
        self.length += count - again
        for name, fill in (
            ("chain", END),
            ("ids", 0),
            ("xy", 0),
            ("crossing_type", END),
            ("visibility", 0),
            ("named", True),
        ):
            setattr(self, name, grown(getattr(self, name), self.length, fill))
        return np.asarray(slots, np.int32)

    def _link(self, slots: Slots) -> None:
        block = self.directory.at(*self.xy[slots].T)
        order = np.argsort(block, kind="stable")
        block, slots = block[order], slots[order]
        last = np.append(block[1:] != block[:-1], True)[: len(block)]
        self.chain[slots[:-1]] = slots[1:]
        self.chain[slots[last]] = self.head[block[last]]
        first = np.append(True, last[:-1])[: len(block)]
        self.head[block[first]] = slots[first]

    def _unlink(self, slot: int, block: int) -> None:
        at, after = int(self.head[block]), int(self.chain[slot])
        if at == slot:
            self.head[block] = after
            return
        while int(self.chain[at]) != slot:
            at = int(self.chain[at])
        self.chain[at] = after


def visible_255(landmarks: Landmarks) -> NDArray[np.uint8]:
    """(L,) chance that a view shows each that is in it, in 1/255: the mean of a uniform prior after what was counted
    since it was born, for it was born because it was seen."""
    seen, expected = (np.maximum(n - BORN_BY, 0) for n in (landmarks.sightings, landmarks.expected))
    return np.round(255.0 * (seen + 1.0) / (expected + 2.0)).astype(np.uint8)


def _touched(xy: Fine, reach: int) -> Fine:
    """(C, 2) places of all blocks that squares of +-reach around points (N, 2) touch, some more than once."""
    steps = np.linspace(-reach, reach, 2 + 2 * reach // (1 << BLOCK_SHIFT)).astype(np.int32)
    corners = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 1, 2)
    return (xy + corners).reshape(-1, 2) >> BLOCK_SHIFT
