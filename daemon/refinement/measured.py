"""What a tape or a surveyor measured, by the names of landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceilvo.daemon.refinement.solver import RefinementError
from ceilvo.daemon.refinement.survey import Anchors, Floor, Survey, index_of
from ceilvo.types import Array, Ints


@dataclass(frozen=True)
class Tape:
    """A distance between two landmarks of a floor, by their ids."""

    floor: int
    ids: tuple[int, int]
    length_m: float
    sigma_m: float


@dataclass(frozen=True)
class Marked:
    """A landmark of a floor, by its id, where a surveyor saw it (2,)."""

    floor: int
    id: int
    xy_m: Array
    sigma_m: float


@dataclass(frozen=True)
class Measured:
    """All of it."""

    tapes: tuple[Tape, ...] = ()
    marks: tuple[Marked, ...] = ()

    def on(self, survey: Survey) -> Anchors:
        """By the indices of the survey's landmarks.

        Raises:
            RefinementError: fewer than two key poses saw one of them.
        """
        between = [_index(survey, t.floor, i) for t in self.tapes for i in t.ids]
        return Anchors(
            between=np.array(between, np.int64).reshape(-1, 2),
            distance_m=np.array([t.length_m for t in self.tapes]),
            distance_sigma_m=np.array([t.sigma_m for t in self.tapes]),
            mark=np.array([_index(survey, m.floor, m.id) for m in self.marks], np.int64),
            mark_xy_m=np.array([m.xy_m for m in self.marks]).reshape(-1, 2),
            mark_sigma_m=np.array([m.sigma_m for m in self.marks]),
        )

    def renamed(self, floors: Sequence[Floor], names: Sequence[Ints]) -> Measured:
        """With the ids (L,) that the landmarks of the floors have now."""

        def now(floor: int, before: int) -> int:
            at = int(index_of(np.array([before]), floors[floor].landmarks.ids)[0])
            return int(names[floor][at]) if at >= 0 else before

        tapes = (replace(t, ids=(now(t.floor, t.ids[0]), now(t.floor, t.ids[1]))) for t in self.tapes)
        return Measured(tuple(tapes), tuple(replace(m, id=now(m.floor, m.id)) for m in self.marks))


def _index(survey: Survey, floor: int, name: int) -> int:
    found = np.flatnonzero((survey.landmark_floor == floor) & (survey.ids == name))
    if not len(found):
        raise RefinementError(
            f"landmark {name}, which was measured, was seen from fewer than two key poses; measure to another one"
        )
    return int(found[0])
