"""The map that was chosen becomes the robot's own, at a start of the daemon, before anything reads it."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import copy_of, floors_in, frames_in, keep_copy, open_map
from ceilvo.daemon.map.kept.kept_map import OLD_NAME
from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME
from ceilvo.daemon.shelf.shelf import Choice, Name, Shelf
from ceilvo.errors import CeilvoError, one_line


@dataclass(frozen=True)
class InUse:
    """
    Attributes:
        name: of the map in use: as it was brought here, else its floor's, else the robot's own name for it.
        floor: that it is on, as the database calls it; "" for the only one.
        others: floors of the database beside it.
    """

    name: Name
    floor: str = ""
    others: tuple[str, ...] = ()


def in_use(state_dir: Path, choice: Choice, floor: str, own: str) -> InUse:
    """Arguments as take_chosen()."""
    path = state_dir / MAP_NAME
    if not path.exists():
        return InUse(Name(floor or own, ""), floor)
    try:
        frames = frames_in(path)
    except CeilvoError:  # it is held or damaged now, and no other one for that
        return InUse(choice.used or Name(floor or own, ""), floor)
    home = _floor(floor, tuple(frames))
    others = tuple(f for f in frames if f != home)
    if choice.used is not None and frames.get(home) == choice.frame:
        return InUse(choice.used, home, others)
    return InUse(Name(home or own, ""), home, others)


@dataclass(frozen=True)
class Taken:
    """Whether the chosen map was taken, and what was done or why not, for people."""

    ok: bool
    said: str


def take_chosen(state_dir: Path, floor: str, own: str) -> Taken | None:
    """Put the robot's map on the chosen one; None where nothing was chosen.

    The map that was in use, with all that the robot learnt on it, goes to the shelf. The last pose was on that map and
    is forgotten: the robot is searched for on all of the new one. An edit is in the log, which `ceilvod map undo` takes
    back. Killed on the way it is done again at the next start.

    Args:
        floor: service.floor.
        own: what the map is called that was in use before any was chosen, where its floor has no name.
    """
    shelf = Shelf(state_dir)
    choice, path = shelf.choice(), state_dir / MAP_NAME
    if choice.next is None or _is_imported_first(state_dir):
        return None
    wanted = choice.next
    try:
        frame = _take(shelf, choice, wanted, path, floor, own)
        shelf.choose(Choice(wanted, frame))
    except (CeilvoError, OSError) as e:
        why = f"map {wanted} not taken: {one_line(str(e))}; the map in use stays"
        try:
            shelf.choose(replace(choice, next=None, refused=why))
        except CeilvoError as also:
            why += f"; {also}"
        return Taken(False, why)
    return Taken(True, f"map {wanted} taken, which was chosen; the one before is in {shelf.folder.name}/")


def _is_imported_first(state_dir: Path) -> bool:
    """The daemon makes a database of an old map at its start; the chosen one is taken at the next."""
    path = state_dir / MAP_NAME
    return not (path.exists() or copy_of(path).exists()) and (state_dir / OLD_NAME).exists()


def _take(shelf: Shelf, choice: Choice, wanted: Name, path: Path, floor: str, own: str) -> str:
    """The frame of the database then."""
    content = shelf.read(wanted)
    there = floors_in(path) if os.path.lexists(path) else ()
    with open_map(path, _floor(floor, there) or None, create=True) as db:
        before = db.content()
        if not _same(before, content):
            if len(before.landmarks):
                shelf.put(in_use(path.parent, choice, floor, own).name, before)
            db.edit(replace(content, floor=db.floor), f"enableMap {wanted}")
        path.with_name(STATE_NAME).unlink(missing_ok=True)
        keep_copy(db)
        return db.frame


def _floor(floor: str, there: tuple[str, ...]) -> str:
    """The one that is kept: that of the configuration, else the first."""
    return floor if floor or not there else there[0]


def _same(a: MapContent, b: MapContent) -> bool:
    return (
        len(a.landmarks) == len(b.landmarks)
        and np.array_equal(a.landmarks.ids, b.landmarks.ids)
        and np.array_equal(a.landmarks.xy_map_m, b.landmarks.xy_map_m)
        and a.axis_rad == b.axis_rad
    )
