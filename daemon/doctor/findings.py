"""What the doctor looks at, and what it says: one line a finding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from ceilvo.config import Config
from ceilvo.drivers.camera import v4l2_query
from ceilvo.drivers.camera.v4l2_device import LinuxDevice
from ceilvo.drivers.camera.v4l2_query import Offer
from ceilvo.drivers.host.machine import Machine


@dataclass(frozen=True, slots=True)
class Finding:
    """check is a word; level says whether text is good news, worth knowing, or a fault with what to do about it."""

    check: str
    level: Literal["fine", "note", "wrong"]
    text: str


def fine(check: str, text: str) -> Finding:
    return Finding(check, "fine", text)


def note(check: str, text: str) -> Finding:
    return Finding(check, "note", text)


def wrong(check: str, text: str) -> Finding:
    return Finding(check, "wrong", text)


Query = Callable[[str, str, int, int], Offer]


@dataclass(frozen=True)
class Patient:
    """What the checks look at; the last three are fakes in tests.

    Attributes:
        config: None when the file is wrong: then only the computer itself is looked at.
        state_dir: where map, state and recordings go; None = nothing is kept.
        running: the daemon as systemd sees it, "" = it does not run.
    """

    config: Config | None
    config_path: Path
    state_dir: Path | None
    running: str = ""
    machine: Machine = field(default_factory=Machine)
    devices: LinuxDevice = field(default_factory=LinuxDevice)
    query: Query = v4l2_query.query

    def holds_all(self, holders: list[str]) -> bool:
        """Whether nobody but the daemon has it."""
        return bool(self.running) and all(h.endswith(f"(pid {self.running})") for h in holders)
