"""One edit of a map: what it would do, with a picture, and doing it."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ceilvo.daemon.editing import sources
from ceilvo.daemon.editing.joining import Matches, matches_by_id
from ceilvo.daemon.editing.picture import Change, draw
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import keep_copy, open_map
from ceilvo.errors import CeilvoError, one_line

Edit = Callable[[MapContent], MapContent]


@dataclass(frozen=True)
class Where:
    """Files of an edit, as its options say.

    Attributes:
        file: the map.
        floor: which one of a database; None: the only one.
        out: a new file for the result; None: the database itself, which can undo it.
        png: a picture of the change.
        dry_run: nothing but the picture is written.
    """

    file: Path
    floor: str | None
    out: Path | None
    png: Path | None
    dry_run: bool

    @staticmethod
    def of(options: argparse.Namespace) -> Where:
        return Where(options.file, options.floor, options.out, options.png, options.dry_run)


def apply(where: Where, edit: Edit, what: str) -> int:
    """Do an edit, or say what it would do; the exit code.

    Raises:
        CeilvoError: it cannot be done; nothing is changed then.
    """
    if where.out is None and not where.dry_run and not sources.is_database(where.file):
        raise CeilvoError(
            f"{where.file}: no database, so nothing could be undone; give --out NEW.json, "
            "or 'ceilvod map import' it first"
        )
    before, found = sources.read_with_hash(where.file, where.floor)
    after = edit(before)
    change = matches_by_id(before.landmarks, after.landmarks)
    print(f"{where.file}: {_said(before, after, change, where.dry_run)}")
    if where.png is not None:
        show(where.png, before, after, change, f"{'would be: ' if where.dry_run else ''}{what}")
    if where.dry_run:
        return 0
    if where.out is not None:
        sources.write(where.out, after, what)
        print(f"{where.out}: written; {where.file} stays as it is")
        return 0
    with open_map(where.file, where.floor) as db:
        keep_copy(db)
        db.edit(after, one_line(what), found)
        print(f"{where.file}: done, hash {db.hash[:12]}; 'ceilvod map undo {where.file}' takes it back")
    return 0


def show(path: Path, before: MapContent, after: MapContent, change: Matches, what: str) -> None:
    """A picture of a change."""
    drawn = Change.of(before.landmarks, after.landmarks, change)
    sources.write_picture(path, draw(after, one_line(what), drawn))
    print(f"{path}: picture written")


def _said(before: MapContent, after: MapContent, change: Matches, dry_run: bool) -> str:
    removed, added, moved = len(change.only_a), len(change.only_b), int(change.moved(0.0).sum())
    poses = sum(map(len, before.key_poses)), sum(map(len, after.key_poses))
    remove, add, move = ("would remove", "add", "move") if dry_run else ("removes", "adds", "moves")
    turned = (
        f", axis {_deg(before.axis_rad)} to {_deg(after.axis_rad)} deg" if before.axis_rad != after.axis_rad else ""
    )
    return (
        f"{remove} {removed}, {add} {added} and {move} {moved} of {len(before.landmarks)} landmarks, "
        f"{len(after.landmarks)} then; key poses {poses[0]} to {poses[1]}{turned}"
    )


def _deg(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):.2f}"
