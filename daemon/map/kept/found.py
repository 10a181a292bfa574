"""A map that can be used, and those of the floors that its transitions lead to."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ceilvo.daemon.map.database.copies import sides_in
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.daemon.map.transitions import Side
from ceilvo.errors import FileFormatError

_log = logging.getLogger("ceilvo.store")


@dataclass(frozen=True)
class Found:
    """A map that can be used.

    Attributes:
        frame: that poses on it are of, see MapDatabase; "" where nobody knows.
        name: of the file that it is from.
        floor: its name in that; sides: of its transitions.
    """

    map: StoredMap
    frame: str
    name: str
    floor: str = ""
    sides: tuple[Side, ...] = ()


def floors_around(home: Found, floor: str, path: Path) -> tuple[Found, ...]:
    """The home floor's map, and those of all floors of a database that one can get to from it.

    What cannot be read is left out, and a line says so.
    """
    out = [home]
    try:
        sides = sides_in(path)
        out = [replace(home, floor=floor, sides=sides.get(floor, ()))]
        for name in reachable(floor, sides)[1:]:
            with MapDatabase(path, name) as db:
                found = found_in(db)
            if found is not None:
                out.append(replace(found, floor=name, sides=sides[name]))
    except FileFormatError as e:
        _log.warning("%s; its other floors are left out", e)
    return tuple(out)


def reachable(home: str, sides: Mapping[str, Sequence[Side]]) -> list[str]:
    """The floors that one can get to from `home`, which is the first, by transitions of one name on both."""
    out = [home]
    for floor in out:
        names = {s.name for s in sides.get(floor, ())}
        out += [f for f in sides if f not in out and names & {s.name for s in sides[f]}]
    return out


def found_in(db: MapDatabase) -> Found | None:
    stored = db.load()
    return None if stored is None else Found(stored, db.frame, db.path.name)
