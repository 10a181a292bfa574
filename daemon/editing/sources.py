"""Where maps come from and go to: a database, a robot's map.json, or an export."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2

from ceilvo.daemon.editing.exchange import FORMAT, VERSION, from_geojson, from_json
from ceilvo.daemon.map.checks import Damage
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import copy_of, open_map
from ceilvo.daemon.map.database.faults import MAGIC
from ceilvo.daemon.map.document import content_bytes, content_of, parsed
from ceilvo.daemon.map.map_file import load_map, save_map
from ceilvo.daemon.replay.drawing.overlay import Image
from ceilvo.errors import CeilvoError, FileFormatError
from ceilvo.files import write_atomic

MOST_BYTES = 2**30
"""Largest export that is read; chosen: 200,000 landmarks are 60 MB of it."""
DATABASE, MAP_JSON = "database", "map.json"
_SUFFIXES = {".db": DATABASE, ".json": MAP_JSON}


def is_database(path: Path) -> bool:
    """Whether SQLite wrote the file, or a copy says that it did."""
    try:
        with path.open("rb") as f:
            return f.read(len(MAGIC)) == MAGIC or copy_of(path).is_file()
    except (OSError, ValueError):
        return copy_of(path).is_file() or path.suffix == ".db"


def read(path: Path, floor: str | None = None) -> MapContent:
    """A map, wherever it lies; arguments and errors as read_with_hash."""
    return read_with_hash(path, floor)[0]


def read_with_hash(path: Path, floor: str | None = None) -> tuple[MapContent, str]:
    """A map, wherever it lies, and in a database its hash, "" elsewhere.

    Args:
        floor: which one of a database; None: the only one.

    Raises:
        FileFormatError: there is none, or it cannot be used.
    """
    if is_database(path):
        with open_map(path, floor) as db:
            if not db.version:
                raise FileFormatError(
                    f"{path}: holds no map{f' of floor {floor!r}' if floor else ''}; import one first"
                )
            return db.content(), db.hash
    try:
        raw = content_bytes(path, MOST_BYTES)
        if raw is None:
            raise Damage("no such file, expected a database of maps, a map.json or an export")
        return _from_text(path, raw), ""
    except Damage as e:
        raise FileFormatError(f"{path}: {e}; check its name, or restore a backup") from e


def _from_text(path: Path, raw: bytes) -> MapContent:
    document: Any = parsed(raw, MOST_BYTES)
    if not isinstance(document, dict):
        raise Damage("neither a database of maps nor a map.json nor an export")
    if document.get("type") == "FeatureCollection":
        return from_geojson(document)
    if document.get("format") == FORMAT:
        return from_json(*content_of(raw, FORMAT, VERSION, MOST_BYTES))
    stored = load_map(path)
    if stored is None:
        raise Damage("gone while it was read")
    return MapContent.of(stored.landmarks, stored.map_axis_rad)


def write(path: Path, content: MapContent, what: str) -> None:
    """A new file of what its name says: NAME.db is a database, NAME.json a robot's map.json.

    Raises:
        CeilvoError: it is there already, its name says nothing, or it cannot be written.
    """
    kind = _SUFFIXES.get(path.suffix)
    if kind is None:
        raise CeilvoError(f"{path}: ends in {path.suffix!r}, expected a name that ends in .db or .json")
    if path.exists():
        raise CeilvoError(f"{path}: is there already, expected a new name")
    if kind == MAP_JSON:
        save_map(path, content.landmarks, content.axis_rad)
        return
    with open_map(path, content.floor, create=True) as db:
        db.edit(content, what)


def write_file(path: Path, data: bytes | str) -> None:
    """An export or a picture; one that is there is replaced.

    Raises:
        CeilvoError: it cannot be written.
    """
    try:
        write_atomic(path, data)
    except (OSError, ValueError) as e:
        why = (e.strerror or str(e)) if isinstance(e, OSError) else str(e)
        raise CeilvoError(f"{path}: cannot be written: {why}; check its folder and its owner") from e


def write_picture(path: Path, image: Image) -> None:
    """A PNG, as write_file()."""
    write_file(path, cv2.imencode(".png", image)[1].tobytes())
