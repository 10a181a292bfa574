"""The landmarks that typed tapes and marks mean."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ceilvo.daemon.building.typed import TypedMark, TypedTape
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.refinement.measured import Marked, Measured, Tape
from ceilvo.daemon.refinement.survey import Floor, index_of
from ceilvo.errors import CeilvoError
from ceilvo.types import Array, Ints

REACH_M = 0.3
"""A landmark is meant when it is no further off; chosen: half of a small tile."""
_LEAST_VIEWS = 2
"""Of a landmark that is measured."""


def measured(
    names: Sequence[str],
    floors: Sequence[Floor],
    tapes: Sequence[TypedTape],
    marks: Sequence[TypedMark],
    tape_sigma_m: float,
    mark_sigma_m: float,
) -> Measured:
    """What was typed, by landmarks.

    Args:
        names: of the floors.

    Raises:
        CeilvoError: no such floor, or no landmark there that two key poses saw.
    """
    seen = [_seen_often(f) for f in floors]

    def near(option: str, text: str, floor: int, at_m: Array) -> int:
        which = seen[floor]
        off = np.hypot(*(floors[floor].landmarks.xy_map_m[which] - at_m).T)
        best = int(np.argmin(off)) if len(which) else -1
        if best < 0 or off[best] > REACH_M:
            nearest = f"the nearest is {off[best]:.2f} m off" if best >= 0 else "there is none at all"
            raise CeilvoError(
                f"{option} {text}: no landmark that {_LEAST_VIEWS} key poses saw within {REACH_M:g} m of "
                f"{at_m[0]:g},{at_m[1]:g}, {nearest}; 'ceilvod map export --geojson' has where they are"
            )
        return int(floors[floor].landmarks.ids[which[best]])

    out_tapes = []
    for t in tapes:
        floor = floor_of(names, t.floor, "--tape", t.text)
        ids = (near("--tape", t.text, floor, t.ends_m[0]), near("--tape", t.text, floor, t.ends_m[1]))
        if ids[0] == ids[1]:
            raise CeilvoError(f"--tape {t.text}: both ends are one landmark, expected two; measure a longer way")
        out_tapes.append(Tape(floor, ids, t.length_m, tape_sigma_m))
    out_marks = []
    for m in marks:
        floor = floor_of(names, m.floor, "--mark", m.text)
        name = near("--mark", m.text, floor, m.mark.here_m)
        out_marks.append(Marked(floor, name, m.mark.there_m, mark_sigma_m))
    return Measured(tuple(out_tapes), tuple(out_marks))


def floor_of(names: Sequence[str], name: str, option: str, text: str) -> int:
    """Its place in names; "" where there is one only.

    Raises:
        CeilvoError: there is none of that name.
    """
    if name in names:
        return list(names).index(name)
    if not name and len(names) == 1:
        return 0
    raise CeilvoError(f"{option} {text}: floor {name!r}, expected one of {', '.join(names)}, as FLOOR@...")


def _seen_often(floor: Floor) -> Ints:
    """Indices of landmarks that enough key poses show."""
    counts = np.zeros(len(floor.landmarks), np.int64)
    for s in floor.sessions:
        at = _once(s, index_of(s.landmark, floor.landmarks.ids))
        counts += np.bincount(at, minlength=len(counts))
    return np.flatnonzero(counts >= _LEAST_VIEWS)


def _once(s: KeyPoses, at: Ints) -> Ints:
    """Landmarks of all views, each once a view."""
    known = at >= 0
    return np.unique(np.column_stack([s.view[known], at[known]]), axis=0)[:, 1]
