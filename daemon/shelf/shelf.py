"""Maps beside the one in use, each in a file of its own, and which of them is to be used next."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote, unquote

from ceilvo.daemon.editing.exchange import to_json
from ceilvo.daemon.editing.sources import read
from ceilvo.daemon.map.checks import Damage, keys, shown
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.document import content_bytes, content_of, document_of
from ceilvo.daemon.map.kept.store import SHELF
from ceilvo.errors import CeilvoError, one_line
from ceilvo.files import write_atomic

MOST_MAPS = 50
"""On a shelf; chosen: a campus. A robot's disk is not a library."""
_CHOICE, _FORMAT, _VERSION = "choice.json", "ceilvo-choice", 1
_MOST_CHOICE_BYTES = 64 * 2**10
_MOST_NAME_BYTES = 200
"""Of a file's name; file systems take 255."""
_SUFFIX = ".map.json"


class Name(NamedTuple):
    """What a fleet calls a map; the version is "" for the map that was there before any came."""

    id: str
    version: str

    def __str__(self) -> str:
        return f"{self.id} {self.version}".strip()


@dataclass(frozen=True)
class Choice:
    """
    Attributes:
        used: the map that the daemon took last; None: its own.
        frame: of the database since then, see MapDatabase.frame: with another one it is that map no more.
        next: what its next start takes; None: nothing.
        refused: what a start could not take, and why; "" where the last one could.
    """

    used: Name | None = None
    frame: str = ""
    next: Name | None = None
    refused: str = ""


class Shelf:
    """Any number of processes may look; files are replaced as a whole."""

    def __init__(self, state_dir: Path) -> None:
        self.folder = state_dir / SHELF

    def names(self) -> tuple[Name, ...]:
        """Of all maps that lie here."""
        with contextlib.suppress(OSError):
            return tuple(sorted(n for n in map(_name_of, self.folder.iterdir()) if n is not None))
        return ()

    def read(self, name: Name) -> MapContent:
        """
        Raises:
            CeilvoError: it is not here, or is damaged.
        """
        path = self._path(name)
        if not path.exists():
            raise CeilvoError(f"map {_told(name)}: is not here, expected one of: {self._all()}; downloadMap brings it")
        return read(path)

    def put(self, name: Name, content: MapContent) -> None:
        """One of this name is replaced.

        Raises:
            CeilvoError: there are too many, the name is no good, or the disk refuses.
        """
        path, there = self._path(name), self.names()
        if name not in there and len(there) >= MOST_MAPS:
            raise CeilvoError(f"found {len(there)} maps, expected at most {MOST_MAPS}; delete one with deleteMap")
        try:
            self.folder.mkdir(exist_ok=True)
            write_atomic(path, to_json(content))
        except OSError as e:
            raise CeilvoError(f"{path}: cannot be written: {e.strerror or e}; check the folder and its owner") from e

    def remove(self, name: Name) -> None:
        """
        Raises:
            CeilvoError: it is not here, it is wanted, or the disk refuses.
        """
        if name == self.choice().next:
            raise CeilvoError(f"map {_told(name)}: the next start takes it, expected another one; enable another first")
        if name not in self.names():
            raise CeilvoError(f"map {_told(name)}: is not here, expected one of: {self._all()}")
        path = self._path(name)
        try:
            path.unlink()
        except OSError as e:
            raise CeilvoError(f"{path}: cannot be removed: {e.strerror or e}") from e

    def choice(self) -> Choice:
        """One that cannot be read counts as none: the map in use stays."""
        with contextlib.suppress(Damage):
            raw = content_bytes(self.folder / _CHOICE, _MOST_CHOICE_BYTES)
            return Choice() if raw is None else _choice(content_of(raw, _FORMAT, _VERSION, _MOST_CHOICE_BYTES)[0])
        return Choice()

    def choose(self, choice: Choice) -> None:
        """
        Raises:
            CeilvoError: the disk refuses.
        """
        path = self.folder / _CHOICE
        body = {"used": choice.used, "frame": choice.frame, "next": choice.next, "refused": choice.refused}
        try:
            self.folder.mkdir(exist_ok=True)
            write_atomic(path, document_of(_FORMAT, _VERSION, body))
        except OSError as e:
            raise CeilvoError(f"{path}: cannot be written: {e.strerror or e}; check the folder and its owner") from e

    def want(self, name: Name) -> None:
        """The daemon's next start takes it.

        Raises:
            CeilvoError: it is not here, is damaged, or the disk refuses.
        """
        self.read(name)
        self.choose(replace(self.choice(), next=name, refused=""))

    def _path(self, name: Name) -> Path:
        file = "@".join(quote(part, safe="") for part in name) + _SUFFIX
        if not name.id or not (name.id + name.version).isprintable() or len(file) > _MOST_NAME_BYTES:
            raise CeilvoError(f"map {_told(name)}: expected a mapId and mapVersion of some 60 letters at most")
        return self.folder / file

    def _all(self) -> str:
        return ", ".join(_told(n) for n in self.names()) or "none"


def _name_of(path: Path) -> Name | None:
    if not path.name.endswith(_SUFFIX):
        return None
    map_id, _, version = path.name.removesuffix(_SUFFIX).partition("@")
    return Name(unquote(map_id), unquote(version))


def _told(name: Name) -> str:
    return one_line(repr(str(name)), 80)


def _choice(body: Any) -> Choice:
    keys(body, {"used", "frame", "next", "refused"}, "content")
    texts = body["frame"], body["refused"]
    if not all(isinstance(t, str) for t in texts):
        raise Damage(f"frame and refused are {shown(texts)}, expected texts")
    return Choice(_name(body["used"]), body["frame"], _name(body["next"]), body["refused"])


def _name(value: Any) -> Name | None:
    if value is None:
        return None
    if not (isinstance(value, list) and len(value) == 2 and all(isinstance(v, str) for v in value)):
        raise Damage(f"a map is {shown(value)}, expected its id and its version")
    return Name(*value)
