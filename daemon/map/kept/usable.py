"""What a file of an earlier run holds; one that cannot be used makes way, and a line says so."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ceilvo.daemon.map.database.copies import put_in_place
from ceilvo.errors import FileFormatError
from ceilvo.files import set_aside

_log = logging.getLogger("ceilvo.store")

_T = TypeVar("_T")


def usable(path: Path, load: Callable[[Path], _T | None]) -> _T | None:
    """What a file holds, None where there is none that can be used.

    What cannot be used is set aside before it would be overwritten: it may be mendable, or of a newer ceilvo.
    """
    try:
        return load(path)
    except FileFormatError as e:
        _log.warning("%s; %s", e, out_of_the_way(path))
    return None


def out_of_the_way(path: Path) -> str:
    """Set something aside; what became of it, for people."""
    try:
        return f"set aside as {set_aside(path).name}"
    except OSError as e:
        return f"it cannot be set aside: {e.strerror or e}"


def copy_in_place_of_link(path: Path) -> None:
    """What a link leads to is used, and stays as it is: SQLite would write there, and keep its log there."""
    if not (path.is_symlink() and path.is_file()):
        return
    leads_to = path.readlink()
    with contextlib.suppress(OSError):
        aside = put_in_place(path, path)
        name = "nothing" if aside is None else aside.name
        _log.warning("%s: a link to %s, expected a file; a copy of that is used; set aside as %s", path, leads_to, name)
