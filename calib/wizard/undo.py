"""Taking a step of the engineer's back: the session's files as they were before it."""

from __future__ import annotations

import shutil
from pathlib import Path

from ceilvo.calib.session.session import CALIBRATION
from ceilvo.errors import CalibrationError

FOLDER = "undo"
_MOST = 10
"""Steps back; chosen: a session's files are a megabyte."""
_KEPT = ("*.json", "*.jsonl", CALIBRATION, "wizard/*.json")
_WHAT = "what.txt"


class Undo:
    """Copies of a session, the newest with the highest number."""

    def __init__(self, session: Path) -> None:
        self._session = session

    @property
    def what(self) -> str:
        """The latest thing that can be taken back, "" where there is none."""
        latest = next(iter(self._copies()[-1:]), None)
        try:
            return "" if latest is None else (latest / _WHAT).read_text(encoding="utf-8")
        except OSError:
            return ""

    def keep(self, what: str) -> None:
        """Before something is changed.

        Raises:
            CalibrationError: the disk refuses; then nothing is to be changed.
        """
        copies = self._copies()
        number = int(copies[-1].name) + 1 if copies else 1
        to = self._session / FOLDER / f"{number:06d}"
        try:
            if to.exists():  # cut short
                shutil.rmtree(to)
            to.mkdir(parents=True)
            for path in self._files():
                inside = to / path.relative_to(self._session)
                inside.parent.mkdir(exist_ok=True)
                shutil.copy2(path, inside)
            (to / _WHAT).write_text(what, encoding="utf-8")
            for old in copies[: 1 - _MOST]:
                shutil.rmtree(old)
        except OSError as e:
            raise CalibrationError(f"{to}: cannot be written ({e.strerror}); nothing was changed, make room") from None

    def back(self) -> str:
        """Put the files back as they were before the latest change; what that was.

        Raises:
            CalibrationError: there is nothing to take back, or the disk refuses.
        """
        copies = self._copies()
        if not copies:
            raise CalibrationError(f"{self._session}: found nothing that could be taken back")
        latest, what = copies[-1], self.what
        try:
            for path in self._files():
                path.unlink()
            for path in sorted(p for p in latest.rglob("*") if p.is_file() and p.name != _WHAT):
                to = self._session / path.relative_to(latest)
                to.parent.mkdir(exist_ok=True)
                shutil.copy2(path, to)
            shutil.rmtree(latest)
        except OSError as e:
            raise CalibrationError(f"{self._session}: cannot be written ({e.strerror}); the copy is {latest}") from None
        return what

    def _copies(self) -> list[Path]:
        """Whole ones: what was cut short has no word of what it is for."""
        found = (self._session / FOLDER).glob(f"[0-9]*/{_WHAT}")
        return sorted(p.parent for p in found)

    def _files(self) -> list[Path]:
        return sorted(p for pattern in _KEPT for p in self._session.glob(pattern) if p.is_file())
