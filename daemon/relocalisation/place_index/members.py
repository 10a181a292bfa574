"""Landmarks by their type: which there are, so that what is rare can be looked up first."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.crossing_types import CROSSING_TYPES
from ceilvo.daemon.relocalisation.place_index.blocks import grown
from ceilvo.daemon.relocalisation.place_index.id_table import Slots
from ceilvo.types import Ints


@dataclass(slots=True)
class Members:
    """Slots of each type.

    Attributes:
        slots: of each type, the first count[t] are valid.
        count: (CROSSING_TYPES,).
        place: (S,) where a slot stands among those of its type.
    """

    slots: list[Slots] = field(default_factory=lambda: [np.empty(0, np.int32) for _ in range(CROSSING_TYPES)])
    count: Ints = field(default_factory=lambda: np.zeros(CROSSING_TYPES, np.int64))
    place: Slots = field(default_factory=lambda: np.empty(0, np.int32))

    def __post_init__(self) -> None:
        """Recordings that are older than points have fewer types."""
        more = CROSSING_TYPES - len(self.count)
        self.count = np.concatenate([self.count, np.zeros(more, np.int64)]) if more > 0 else self.count
        self.slots = [*self.slots, *(np.empty(0, np.int32) for _ in range(more))]

    def of(self, kind: int) -> Slots:
        return self.slots[kind][: self.count[kind]]

    def add(self, slots: Slots, kinds: Ints) -> None:
        self.place = grown(self.place, int(np.max(slots, initial=-1)) + 1)
        for kind in np.unique(kinds).tolist():
            more, begin = slots[kinds == kind], int(self.count[kind])
            self.slots[kind] = grown(self.slots[kind], begin + len(more))
            self.slots[kind][begin : begin + len(more)] = more
            self.place[more] = begin + np.arange(len(more))
            self.count[kind] += len(more)

    def remove(self, slots: Slots, kinds: Ints) -> None:
        """The last of a type takes the place of one that goes."""
        for slot, kind in zip(slots.tolist(), kinds.tolist(), strict=True):
            self.count[kind] -= 1
            last = self.slots[kind][self.count[kind]]
            self.slots[kind][self.place[slot]] = last
            self.place[last] = self.place[slot]

    @property
    def nbytes(self) -> int:
        return self.place.nbytes + sum(s.nbytes for s in self.slots)
