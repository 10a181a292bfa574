"""From a landmark's id to its slot: a hash table of a few bytes a landmark."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Ints

Slots = NDArray[np.int32]

EMPTY, REMOVED = -1, -2
"""In place of a slot: nothing was ever here; something was, so that a search goes on."""
SMALLEST = 16
"""Entries of an empty table."""
LOAD, FRESH_LOAD = 0.7, 0.56
"""Fraction in use, removed entries included, from which the table is made anew, and below which it then is. Linear
probing looks at 2.2 entries for a hit at 0.7 (Knuth, The Art of Computer Programming 3, section 6.4)."""
FIBONACCI = np.uint64(11400714819323198485)
"""2^64 over the golden ratio, made odd: multiplicative hashing (the same section)."""


@dataclass(slots=True)
class IdTable:
    """Open addressing with linear probing; the ids themselves are where the slots are, and handed in as `stored`.

    Attributes:
        slot: (2^bits,) slots, or EMPTY or REMOVED.
        used: entries that are not EMPTY.
    """

    slot: Slots = field(default_factory=lambda: np.full(SMALLEST, EMPTY, np.int32))
    used: int = 0

    def __post_init__(self) -> None:
        """ValueError for entries of a file from which no search would come back."""
        size = len(self.slot)
        if size < SMALLEST or size & (size - 1) or not np.any(self.slot == EMPTY):
            raise ValueError(f"table of {size} entries, expected a power of two with some of them empty")

    def find(self, ids: Ints, stored: Ints) -> Slots:
        """(N,) slots, -1 for an id that is not there."""
        out = np.full(len(ids), EMPTY, np.int32)
        for which, _, slot in self._probe(ids, stored):
            out[which] = slot
        return out

    def insert(self, ids: Ints, slots: Slots, stored: Ints) -> None:
        """Ids (N,) that are not there yet, each once."""
        if self.used + len(ids) > LOAD * len(self.slot):
            self._rebuild(len(ids), stored)
        self._put(ids, slots)

    def remove(self, ids: Ints, stored: Ints) -> None:
        """Ids (N,) that are there, each once."""
        for _, at, _ in list(self._probe(ids, stored)):
            self.slot[at] = REMOVED

    def _probe(self, ids: Ints, stored: Ints) -> list[tuple[Ints, Ints, Slots]]:
        """Which of the ids were found, at which entries, with which slots."""
        found, left, at = [], np.arange(len(ids)), self._first(ids)
        while len(left):
            slot = self.slot[at]
            here = slot >= 0
            here[here] = stored[slot[here]] == ids[left[here]]
            found.append((left[here], at[here], slot[here]))
            on = ~here & (slot != EMPTY)
            left, at = left[on], (at[on] + 1) & (len(self.slot) - 1)
        return found

    def _put(self, ids: Ints, slots: Slots) -> None:
        left, at = np.arange(len(ids)), self._first(ids)
        while len(left):
            free = self.slot[at] == EMPTY
            self.slot[at[free]] = slots[left[free]]
            on = self.slot[at] != slots[left]  # taken before, or by another one of these
            left, at = left[on], (at[on] + 1) & (len(self.slot) - 1)
        self.used += len(ids)

    def _first(self, ids: Ints) -> Ints:
        bits = len(self.slot).bit_length() - 1
        return np.asarray((ids.astype(np.uint64) * FIBONACCI) >> np.uint64(64 - bits), np.int64)

    def _rebuild(self, more: int, stored: Ints) -> None:
        slots = self.slot[self.slot >= 0]
        size = SMALLEST
        while FRESH_LOAD * size < len(slots) + more:
            size *= 2
        self.slot, self.used = np.full(size, EMPTY, np.int32), 0
        self._put(stored[slots], slots)
