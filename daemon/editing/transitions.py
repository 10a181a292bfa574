"""`ceilvod map transition`: lifts and ramps, and where they are on each floor."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ceilvo.config.arguments import command
from ceilvo.daemon.editing.regions import place_on_floor
from ceilvo.daemon.map.checks import Damage
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import floors_in, keep_copy, open_map
from ceilvo.daemon.map.transitions import KINDS, Side
from ceilvo.errors import CeilvoError, one_line, printable
from ceilvo.se2 import wrap
from ceilvo.types import Array

if TYPE_CHECKING:
    from ceilvo.config.arguments import Commands

Maps = dict[str, MapContent]
"""By floors."""


def add(commands: Commands) -> None:
    """`transition` and what follows it."""
    example = "ceilvod map transition list map.db"
    words = command(commands, "transition", "lifts and ramps between floors", example).add_subparsers(
        title="commands", required=True
    )
    p = command(
        words,
        "add",
        "say where a lift or a ramp is on each floor; of one that is there, on more floors or elsewhere",
        "ceilvod map transition add map.db east --kind lift --at ground=3.2,4.1,90 --at first=3.2,4.1,90",
    )
    p.add_argument("file", type=Path, metavar="DB")
    p.add_argument("name", metavar="NAME")
    p.add_argument("--kind", choices=KINDS, default=KINDS[0], help=f"({KINDS[0]})")
    p.add_argument(
        "--at",
        type=place_on_floor,
        action="append",
        required=True,
        metavar="FLOOR=X,Y,DEG",
        help="where a robot stands in the lift, or at an end of the ramp: m, and degrees; once a floor",
    )
    p.set_defaults(do=_add)
    p = command(words, "list", "where lifts and ramps are", "ceilvod map transition list map.db")
    p.add_argument("file", type=Path, metavar="DB")
    p.set_defaults(do=_list)
    p = command(words, "remove", "forget a lift or a ramp", "ceilvod map transition remove map.db east")
    p.add_argument("file", type=Path, metavar="DB")
    p.add_argument("name", metavar="NAME")
    p.set_defaults(do=_remove)


def _add(options: argparse.Namespace) -> int:
    maps, at = _maps(options.file), _places(options.at)
    if unknown := sorted(at.keys() - maps.keys()):
        raise CeilvoError(
            f"--at: {options.file} has no floor {unknown[0]!r}, expected {' or '.join(repr(f) for f in maps)}"
        )
    if len({f for f, m in maps.items() if options.name in _names(m)} | at.keys()) < 2:
        raise CeilvoError(f"--at: {options.name} would be on one floor, expected two or more: --at FLOOR=X,Y,DEG again")
    try:
        for floor, pose in at.items():
            others = [s for s in maps[floor].sides if s.name != options.name]
            side = Side.at(options.name, options.kind, np.append(pose[:2], wrap(float(pose[2]))))
            maps[floor] = replace(maps[floor], sides=tuple(sorted((*others, side), key=lambda s: s.name)))
    except Damage as e:
        raise CeilvoError(f"{e}") from e
    _write(options.file, {floor: maps[floor] for floor in at}, f"transition add {options.name}")
    return _list(options)


def _remove(options: argparse.Namespace) -> int:
    maps = {f: m for f, m in _maps(options.file).items() if options.name in _names(m)}
    if not maps:
        raise CeilvoError(f"{options.file}: has no lift or ramp {options.name!r}; see 'ceilvod map transition list'")
    for floor, m in maps.items():
        maps[floor] = replace(m, sides=tuple(s for s in m.sides if s.name != options.name))
    _write(options.file, maps, f"transition remove {options.name}")
    return _list(options)


def _list(options: argparse.Namespace) -> int:
    """All of them, floor by floor."""
    rows = [(s.name, floor, s) for floor, m in _maps(options.file).items() for s in m.sides]
    for name, floor, s in sorted(rows, key=lambda row: row[:2]):
        at = f"{s.x_m:.3f}, {s.y_m:.3f} m, {math.degrees(s.theta_rad):.1f} deg"
        print(f"{s.kind}  {printable(name)}  on {printable(floor) or 'the only floor'}: {at}")
    if not rows:
        print(f"{options.file}: no lifts or ramps")
    return 0


def _places(given: list[tuple[str, Array]]) -> dict[str, Array]:
    if len({floor for floor, _ in given}) != len(given):
        raise CeilvoError("--at: given twice for one floor, expected once")
    return {floor: np.asarray(pose) for floor, pose in given}


def _names(content: MapContent) -> set[str]:
    return {s.name for s in content.sides}


def _maps(path: Path) -> Maps:
    out = {}
    for floor in floors_in(path):
        with open_map(path, floor) as db:
            out[floor] = db.content()
    return out


def _write(path: Path, maps: Maps, what: str) -> None:
    """On all floors or none, each an edit of its floor that can be undone."""
    with open_map(path, next(iter(maps))) as db:
        keep_copy(db)
        db.edit_floors({floor: (content, "") for floor, content in maps.items()}, one_line(what))
