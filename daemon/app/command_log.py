"""Who told the robot what, and when: lines of JSON in the state directory, bounded."""

from __future__ import annotations

import json
import logging
import os
import stat
import threading
import time
from pathlib import Path

from ceilvo.files import set_aside

_log = logging.getLogger("ceilvo.commands")

NAME = "commands.jsonl"
MOST_BYTES = 1_000_000
"""After which the file becomes NAME.1 and the one before is gone: some 10,000 commands."""
_FIRST_LINE_BYTES = 32_768
"""Enough for the first line: a command has 4096 bytes at most, each of them six as JSON."""


class CommandLog:
    """Thread-safe; without a folder nothing is written. A disk that refuses is said once and stops no command."""

    def __init__(self, folder: Path | None) -> None:
        self._path = None if folder is None else folder / NAME
        self._lock = threading.Lock()
        self._refused = False

    def __call__(self, command: str, arguments: str, who: str, outcome: str) -> None:
        """One command that was taken, or refused for want of a right to it."""
        if self._path is None:
            return
        row = {"unix_ns": time.time_ns(), "command": command, "arguments": arguments, "who": who, "outcome": outcome}
        with self._lock:
            try:
                self._append(self._path, json.dumps(row) + "\n")
            except OSError as e:
                if not self._refused:
                    _log.error("%s: commands are not logged: %s", self._path, e.strerror or e)
                self._refused = True
            else:
                self._refused = False

    def _append(self, path: Path, line: str) -> None:
        if os.path.lexists(path):
            if not _is_log(path):
                _log.warning("%s: no log of commands; set aside as %s", path, set_aside(path).name)
            elif path.stat().st_size > MOST_BYTES:
                path.replace(path.with_name(NAME + ".1"))
        with path.open("ab+") as f:
            f.seek(max(f.tell() - 1, 0))
            torn = f.read(1) not in (b"", b"\n")  # the end of a process that died, or of a full disk
            f.write(b"\n" * torn + line.encode())


def _is_log(path: Path) -> bool:
    """Whether more lines may follow those that are there. A map that lies there by mistake must not be spoilt."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            return False
        with path.open("rb") as f:
            first, _, rest = f.read(_FIRST_LINE_BYTES).partition(b"\n")
        row = json.loads(first or rest or b'{"command": ""}')
        return isinstance(row, dict) and "command" in row
    except (OSError, ValueError, RecursionError):
        return False
