"""The words of `ceilvod map`."""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ceilvo.config.arguments import command
from ceilvo.daemon.editing import looking, sources, transitions
from ceilvo.daemon.editing.changes import alignment, moved, only, turn_about, without
from ceilvo.daemon.editing.editor import Where, apply, show
from ceilvo.daemon.editing.joining import matches_by_id, merged
from ceilvo.daemon.editing.regions import angle_deg, box, mark, point, polygon
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import copy_of, keep_copy, open_map
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.errors import CeilvoError, printable

if TYPE_CHECKING:
    from ceilvo.config.arguments import Commands

_SIGMAS = 3.0
"""That a landmark moves beyond before `diff` says so, unless told; chosen: 1 % of those that did not move do."""


def add(commands: Commands) -> Commands:
    """`map` and what follows it; returned for words of other rooms."""
    p = command(commands, "map", "look at maps, edit them, take edits back", "ceilvod map show map.db --png map.png")
    words: Commands = p.add_subparsers(title="commands", required=True)
    _add_exchange(words)
    _add_looking(words)
    _add_regions(words)
    _add_motions(words)
    _add_merge(words)
    _add_undo(words)
    transitions.add(words)
    return words


def _one(words: Commands, name: str, text: str, example: str, do: Any, file: str = "FILE") -> argparse.ArgumentParser:
    p = command(words, name, text, f"ceilvod map {name} {example}")
    if file:
        p.add_argument("file", type=Path, metavar=file, help="database of maps, map.json or an export")
    p.add_argument("--floor", metavar="NAME", help="which map of a database (default: the only one)")
    p.set_defaults(do=do)
    return p


def _changing(words: Commands, name: str, text: str, example: str, do: Any) -> argparse.ArgumentParser:
    p = _one(words, name, text, example, do)
    _trial(p)
    p.add_argument("--out", type=Path, metavar="NEW", help="write NEW.db or NEW.json instead, and leave FILE as it is")
    return p


def _trial(p: argparse.ArgumentParser) -> None:
    p.add_argument("--dry-run", action="store_true", help="say what would change, and change nothing")
    p.add_argument("--png", type=Path, metavar="PICTURE", help="draw the change")


def _region(p: argparse.ArgumentParser) -> None:
    which = p.add_mutually_exclusive_group(required=True)
    which.add_argument("--box", dest="region", type=box, metavar="X0,Y0,X1,Y1", help="m; below 0 as --box=-1,-2,3,4")
    which.add_argument("--polygon", dest="region", type=polygon, metavar="'X,Y X,Y ...'", help="corners, m")


def _add_exchange(words: Commands) -> None:
    p = _one(words, "import", "bring a map into a database", "map.json --into map.db", _import)
    p.add_argument("--into", type=Path, metavar="DB", required=True, help="made where there is none")
    p.add_argument("--replace", action="store_true", help="instead of the map that is there, which undo brings back")
    _trial(p)
    p = _one(words, "export", "write a map for people and other tools", "map.db --geojson map.geojson", looking.export)
    p.add_argument("--json", type=Path, metavar="FILE", help="everything")
    p.add_argument("--geojson", type=Path, metavar="FILE", help="landmarks and places of key poses, in metres")
    p.add_argument("--png", type=Path, metavar="FILE", help="a picture")
    p.add_argument("--map-json", type=Path, metavar="FILE", help="as robots read it")


def _add_looking(words: Commands) -> None:
    p = _one(words, "show", "draw a map", "map.db --png map.png", looking.show)
    p.add_argument("--png", type=Path, metavar="PICTURE", help="a picture, too")
    p.add_argument("--box", type=box, metavar="X0,Y0,X1,Y1", help="of that part only, m")
    p = _one(words, "stats", "figures of a map", "map.db", looking.stats)
    p.add_argument("--json", action="store_true", help="as JSON")
    p = _one(words, "diff", "what differs between two maps of one frame", "old.json map.db", looking.diff, file="")
    p.add_argument("a", type=Path, metavar="A")
    p.add_argument("b", type=Path, metavar="B")
    p.add_argument("--sigmas", type=_sigmas, default=_SIGMAS, metavar="K", help=f"that count as moved ({_SIGMAS:g})")
    p.add_argument("--by", choices=("id", "place"), help="what makes two landmarks one (default: ids where they agree)")
    p.add_argument("--png", type=Path, metavar="PICTURE", help="draw it")
    _one(words, "history", "edits that can be undone", "map.db", looking.history, file="DB")


def _add_regions(words: Commands) -> None:
    _region(_changing(words, "crop", "keep a region and forget the rest", "map.db --box 0,0,20,10", _crop))
    _region(_changing(words, "forget", "forget a region", "map.db --polygon '2,2 6,2 4,5'", _forget))


def _add_motions(words: Commands) -> None:
    p = _changing(words, "rotate", "turn a map", "map.db --deg 90", _rotate)
    p.add_argument("--deg", type=angle_deg, required=True, metavar="D", help="counter-clockwise")
    p.add_argument("--about", type=point, default=np.zeros(2), metavar="X,Y", help="m (default: the origin)")
    example = "map.db --mark 0,0=12.5,3 --mark 30,0=12.5,33"
    p = _changing(words, "align", "turn and move a map to where a floor plan has two marks", example, _align)
    p.add_argument("--mark", type=mark, action="append", required=True, metavar="x,y=X,Y", help="twice: map=plan, m")


def _add_merge(words: Commands) -> None:
    text = "add a map of the same frame to another"
    p = _changing(words, "merge", text, "map.db other.db", _merge)
    p.add_argument("other", type=Path, metavar="OTHER", help="what is added; it stays as it is")


def _add_undo(words: Commands) -> None:
    p = _one(words, "undo", "take the last edit back", "map.db", _undo, file="DB")
    _trial(p)


# -- what they do


def _import(options: argparse.Namespace) -> int:
    content = sources.read(options.file, None)
    name = content.floor if options.floor is None else options.floor
    content = replace(content, floor=name)
    before = _empty(content)
    if os.path.lexists(options.into) or copy_of(options.into).exists():
        with open_map(options.into, name) as db:
            before = db.content()
            if db.version and not options.replace:
                raise CeilvoError(
                    f"{options.into}: holds a map of {len(before.landmarks)} landmarks; --replace takes its place, "
                    "--floor NAME puts one beside it, 'ceilvod map merge' joins them"
                )
    change = matches_by_id(before.landmarks, content.landmarks)
    would = "would hold" if options.dry_run else "holds"
    if options.png is not None:
        show(options.png, before, content, change, f"import {options.file.name}")
    if not options.dry_run:
        with open_map(options.into, name, create=True) as db:
            db.edit(content, f"import {options.file.name}")
            keep_copy(db)
    poses = sum(map(len, content.key_poses))
    print(f"{options.into}: {would} {len(content.landmarks)} landmarks and {poses} key poses of {options.file}")
    return 0


def _empty(content: MapContent) -> MapContent:
    return MapContent(content.landmarks.of(np.arange(0)), np.empty((0, 2)), 0.0)


def _crop(options: argparse.Namespace) -> int:
    return apply(Where.of(options), lambda m: only(m, options.region.holds), f"crop {options.region.text}")


def _forget(options: argparse.Namespace) -> int:
    return apply(Where.of(options), lambda m: without(m, options.region.holds), f"forget {options.region.text}")


def _rotate(options: argparse.Namespace) -> int:
    x, y = options.about
    motion = turn_about(options.about, math.radians(options.deg))
    return apply(Where.of(options), lambda m: moved(m, motion), f"rotate --deg {options.deg:g} --about {x:g},{y:g}")


def _align(options: argparse.Namespace) -> int:
    if len(options.mark) != 2:
        raise CeilvoError(f"--mark: given {len(options.mark)} times, expected twice: --mark x,y=X,Y --mark x,y=X,Y")
    first, second = options.mark
    motion, longer = alignment(first, second)
    apart = float(np.hypot(*(second.here_m - first.here_m)))
    print(f"turn by {math.degrees(motion[2]):.3f} deg, move by {motion[0]:.3f}, {motion[1]:.3f} m")
    print(f"residual {longer:+.3f} m: the marks are {apart:.3f} m apart in the map, {apart + longer:.3f} m on the plan")
    marks = " ".join(f"--mark {_pair(m.here_m)}={_pair(m.there_m)}" for m in options.mark)
    return apply(Where.of(options), lambda m: moved(m, motion), f"align {marks}")


def _pair(at_m: Any) -> str:
    return f"{at_m[0]:g},{at_m[1]:g}"


def _merge(options: argparse.Namespace) -> int:
    other = sources.read(options.other, None)

    def join(content: MapContent) -> MapContent:
        both, m = merged(content, other)
        print(f"{options.other}: {len(m.b)} landmarks are known, {len(m.only_b)} are new")
        return both

    return apply(Where.of(options), join, f"merge {options.other.name}")


def _undo(options: argparse.Namespace) -> int:
    if not sources.is_database(options.file):
        raise CeilvoError(f"{options.file}: no database of maps, so no edit is known; restore a backup")
    with open_map(options.file, options.floor) as db, tempfile.TemporaryDirectory() as folder:
        before, after = db.content(), _undone(db, Path(folder) / "map.db")
        log = db.history()[0]
        would = "would take back" if options.dry_run else "takes back"
        counts = f"{len(before.landmarks)} to {len(after.landmarks)} landmarks"
        print(f"{options.file}: {would} '{printable(log.what)}', {counts}")
        if options.png is not None:
            show(options.png, before, after, matches_by_id(before.landmarks, after.landmarks), f"undo {log.what}")
        if not options.dry_run:
            db.undo()
            print(f"{options.file}: done, hash {db.hash[:12]}")
    return 0


def _undone(db: MapDatabase, copy: Path) -> MapContent:
    """What it would be, tried on a copy."""
    if not db.history():
        db.undo()  # says so
    db.copy_to(copy)
    with MapDatabase(copy, db.floor) as trial:
        trial.undo()
        return trial.content()


def _sigmas(text: str) -> float:
    value = float(text)
    if not 0.0 < value < 1e3:
        raise argparse.ArgumentTypeError(f"{text}: expected sigmas above 0")
    return value
