"""When a view of landmarks is news: after some travel, some turn, or some time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.config import Filter

_NS = 1e-9
"""Seconds in a nanosecond."""


@dataclass(slots=True)
class ScheduleState:
    """Path and turn since the last update, and its stamp; None when there was none."""

    travel_m: float = 0.0
    turn_rad: float = 0.0
    updated_ns: int | None = None


class UpdateSchedule:
    """Updates from one place would count the same errors again and again."""

    def __init__(self, settings: Filter) -> None:
        self._settings = settings
        self.state = ScheduleState()

    def travelled(self, moved_m: float, turned_rad: float) -> None:
        self.state.travel_m += moved_m
        self.state.turn_rad += turned_rad

    def due(self, stamp_ns: int, period_s: float) -> bool:
        """Whether a view at this moment is news; if so, the next one is counted from it.

        Args:
            period_s: after it even a robot that stands sees news: detection errs anew in every frame.
        """
        s, cfg = self.state, self._settings
        due = (
            s.updated_ns is None
            or s.travel_m >= cfg.update_travel_m
            or s.turn_rad >= np.radians(cfg.update_turn_deg)
            or (stamp_ns - s.updated_ns) * _NS >= period_s
        )
        if due:
            self.state = ScheduleState(updated_ns=stamp_ns)
        return bool(due)

    def restart(self) -> None:
        """The next view is news."""
        self.state = ScheduleState()
