"""Ranges and marks in a running process, as the configuration says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import zenoh

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.relocalisation.beacons.lamps.finder import LampFinder
from ceilvo.daemon.relocalisation.beacons.mark_finder import MarkFinder
from ceilvo.drivers.ports import Clock
from ceilvo.drivers.ranging.link import RangingLink
from ceilvo.drivers.ranging.mailbox import Mailbox
from ceilvo.drivers.ranging.topic import NAME, RangesTopic
from ceilvo.senses.beacon_file import read_beacons
from ceilvo.senses.beacons import Beacons, Range
from ceilvo.senses.heard import Heard
from ceilvo.types import Frame


class BeaconSenses:
    """Opens nothing before start().

    Attributes:
        known: of the file.
    """

    def __init__(
        self,
        config: Config,
        stem: str,
        clock: Clock,
        on_crash: Callable[[BaseException], None],
        calibration: Calibration | None = None,
    ) -> None:
        """
        Args:
            calibration: without it no lamps are looked for.

        Raises:
            ConfigError: beacons.file cannot be used.
        """
        c = config.beacons
        self.known = read_beacons(Path(c.file)) if c.file else Beacons()
        self._mailbox = Mailbox()
        self._link = RangingLink(c, self._mailbox, clock, on_crash) if c.ranges == "serial" else None
        self._topic = RangesTopic(f"{stem}/{NAME}", self._mailbox, clock) if c.ranges == "zenoh" else None
        numbers = frozenset(m.number for m in self.known.marks)
        self._finder = MarkFinder(c.family, numbers) if numbers and c.marks else None
        self._lamps: LampFinder | None = None
        if self.known.lamps and c.marks and calibration is not None:
            self._lamps = LampFinder(calibration, config.features.max_view_deg)
        self._every, self._frames = c.marks_every, 0

    @property
    def keys(self) -> tuple[str, ...]:
        """Of the robot's own keys, those where others speak."""
        return () if self._topic is None else (self._topic.key,)

    def declare(self, session: zenoh.Session) -> None:
        """Listen on Zenoh."""
        if self._topic is not None:
            self._topic.declare(session)

    def start(self) -> None:
        if self._link is not None:
            self._link.start()

    def stop(self) -> None:
        if self._link is not None:
            self._link.stop()

    def ranges(self, stamp_ns: int) -> tuple[Range, ...]:
        """That came up to a stamp."""
        return self._mailbox.take(stamp_ns)

    def shown(self, frame: Frame, sure: bool, heard: Heard) -> Heard:
        """What is heard, with the marks and lamps in a frame, if it is one to look at."""
        self._frames += 1
        if (self._finder is None and self._lamps is None) or (sure and self._frames % self._every):
            return heard
        marks = () if self._finder is None else self._finder(frame.gray)
        lamps = None if self._lamps is None else self._lamps(frame.gray)
        return replace(heard, marks=marks, lamps=lamps) if marks or lamps is not None else heard

    def counters(self) -> dict[str, object]:
        """Of ranges; nothing where none are heard."""
        if self._link is not None:
            return {"ranging": asdict(self._link.snapshot())}
        return {} if self._topic is None else {"ranging": self._topic.counters()}
