"""The senses beside camera and wheels in a running process: what they heard of the time between two frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import zenoh

from ceilvo.config import Config
from ceilvo.daemon.relocalisation.beacons.mark_finder import MarkFinder
from ceilvo.drivers.ports import Clock
from ceilvo.drivers.ranging.link import RangingLink
from ceilvo.drivers.ranging.mailbox import Mailbox
from ceilvo.drivers.ranging.topic import RangesTopic, ranges_key
from ceilvo.senses.beacon_file import read_beacons
from ceilvo.senses.beacons import Beacons
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.types import Frame

Hear = Callable[[int, Frame | None, bool], Heard]
"""What was heard up to a stamp and seen in a frame, if there is one; and whether the place is sure."""


def no_senses(stamp_ns: int, frame: Frame | None, sure: bool) -> Heard:
    """For robots with camera and wheels alone."""
    return NOTHING


class BeaconSenses:
    """Ranges and marks as configured; opens nothing before start()."""

    def __init__(self, config: Config, clock: Clock, on_crash: Callable[[BaseException], None]) -> None:
        """
        Raises:
            ConfigError: beacons.file cannot be used.
        """
        c = config.beacons
        self.known = read_beacons(Path(c.file)) if c.file else Beacons()
        self._mailbox = Mailbox()
        serial, topic = (c.ranges == name and bool(self.known.anchors) for name in ("serial", "zenoh"))
        self._link = RangingLink(c, self._mailbox, clock, on_crash) if serial else None
        key = ranges_key(config.zenoh.prefix, config.robot.name) if topic else ""
        self._topic = RangesTopic(key, self._mailbox, clock) if topic else None
        numbers = frozenset(m.number for m in self.known.marks)
        self._finder = MarkFinder(c.family, numbers) if numbers and c.marks else None
        self._every, self._frames = c.marks_every, 0

    @property
    def any(self) -> bool:
        return bool(self._link or self._topic or self._finder)

    @property
    def speakers(self) -> Sequence[Callable[[zenoh.Session], None]]:
        """For the bus."""
        return () if self._topic is None else (self._topic.declare,)

    def start(self) -> None:
        if self._link is not None:
            self._link.start()

    def stop(self) -> None:
        if self._link is not None:
            self._link.stop()

    def hear(self, stamp_ns: int, frame: Frame | None, sure: bool) -> Heard:
        """As Hear; of the estimator's thread."""
        if not self.any:
            return NOTHING
        self._frames += frame is not None
        look = self._finder is not None and frame is not None and (not sure or self._frames % self._every == 0)
        marks = self._finder(frame.gray) if look and self._finder is not None and frame is not None else ()
        ranges = self._mailbox.take(stamp_ns)
        return Heard(ranges=ranges, marks=marks) if ranges or marks else NOTHING

    def counters(self) -> Mapping[str, Any]:
        """For the health message; empty where there are no such senses."""
        out: dict[str, Any] = {}
        if self._link is not None:
            out["ranging"] = asdict(self._link.snapshot())
        if self._topic is not None:
            out["ranging"] = self._topic.counters()
        return out
