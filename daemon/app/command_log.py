"""Who told the robot what, and when: lines of JSON in the state directory, bounded."""

from __future__ import annotations

import json
import logging
import threading
import time
from pathlib import Path

_log = logging.getLogger("ceilvo.commands")

NAME = "commands.jsonl"
MOST_BYTES = 1_000_000
"""After which the file becomes NAME.1 and the one before is gone: some 10,000 commands."""


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
                if self._path.exists() and self._path.stat().st_size > MOST_BYTES:
                    self._path.replace(self._path.with_name(NAME + ".1"))
                with self._path.open("a", encoding="utf-8") as f:
                    f.write(json.dumps(row) + "\n")
            except OSError as e:
                if not self._refused:
                    _log.error("%s: commands are not logged: %s", self._path, e.strerror or e)
                self._refused = True
            else:
                self._refused = False
