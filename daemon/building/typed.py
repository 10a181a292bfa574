"""What people type for whole buildings: tapes, marks, and files that are for some sessions only."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from ceilvo.daemon.editing.regions import Mark, mark, point
from ceilvo.types import Array

_LONGEST_M, _MOST_MM = 10_000.0, 1000.0


@dataclass(frozen=True)
class TypedTape:
    """Ends (2,) in the map, m; floor "" is the only one."""

    floor: str
    ends_m: tuple[Array, Array]
    length_m: float
    text: str


@dataclass(frozen=True)
class TypedMark:
    """As Mark, on a floor."""

    floor: str
    mark: Mark
    text: str


@dataclass(frozen=True)
class Prefixed:
    """A file, and how the names of the sessions begin that it is meant for."""

    prefix: str
    file: Path


def tape(text: str) -> TypedTape:
    """The type of an option: [FLOOR@]x,y:x,y=LEN in m."""
    floor, _, rest = text.rpartition("@")
    ends, equals, length = rest.partition("=")
    first, colon, second = ends.partition(":")
    if not (equals and colon):
        raise argparse.ArgumentTypeError(f"{text}: expected x,y:x,y=LEN, two points of the map and the tape between")
    try:
        length_m = float(length)
    except ValueError:
        length_m = 0.0
    if not 0.0 < length_m < _LONGEST_M:
        raise argparse.ArgumentTypeError(f"{text}: length {length!r}, expected m above 0")
    return TypedTape(floor, (point(first), point(second)), length_m, text)


def typed_mark(text: str) -> TypedMark:
    """The type of an option: [FLOOR@]x,y=X,Y in m."""
    floor, _, rest = text.rpartition("@")
    return TypedMark(floor, mark(rest), text)


def prefixed(text: str) -> Prefixed:
    """The type of an option: [SESSIONS=]FILE."""
    prefix, _, file = text.rpartition("=")
    if not file:
        raise argparse.ArgumentTypeError(f"{text!r}: expected FILE, or SESSIONS=FILE")
    return Prefixed(prefix, Path(file))


def sigma_mm(text: str) -> float:
    """The type of an option: mm above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value <= _MOST_MM:
        raise argparse.ArgumentTypeError(f"{text}: expected mm above 0, at most {_MOST_MM:g}")
    return value
