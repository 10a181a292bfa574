"""The daemon in its fleet: it begins on the newest map, tells what it learns, and works on while nobody answers."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceilvo.config import Config
from ceilvo.daemon.fleet.extra import loaded
from ceilvo.daemon.map.kept.store import MAP_NAME, STATE_NAME
from ceilvo.daemon.map.map_file import load_state
from ceilvo.errors import CeilvoError, FileFormatError
from ceilvo.types import Estimate, State

if TYPE_CHECKING:
    from ceilvo.daemon.fleet.robot.sync import Met, Standing

PATIENCE_S = 6.0
"""That a start waits for the map service; chosen: a change of a building comes in less, and a robot must drive."""
_PART, _SYNC = "ceilvo.daemon.fleet.robot.part", "ceilvo.daemon.fleet.robot.sync"


class Membership:
    """Of one robot in one fleet; it does nothing where fleet.service is empty."""

    def __init__(
        self,
        config: Config,
        folder: Path | None,
        last: Callable[[], Estimate | None],
        tell: Callable[[str, str, int], None],
    ) -> None:
        """
        Args:
            folder: where the map is kept; None: nowhere, and then there is nothing to share.
            last: the newest estimate; called in another thread.
            tell: an event's name, its text and its level of logging; called in any thread.
        """
        self._config, self._folder, self._last, self._tell_event = config, folder, last, tell
        self._standing: Standing | None = None
        self._contact_ns: int | None = None
        self._error = self._said = ""

    @contextmanager
    def kept_up(self) -> Iterator[None]:
        """To be entered before the map is loaded: it is put on the newest version that can be had soon. Then the
        service is met every fleet.period_s, for as long as the context lasts."""
        if not self._config.fleet.service:
            yield
            return
        try:
            part, sync = loaded(_PART), loaded(_SYNC)
            if self._folder is None:
                raise CeilvoError(f"fleet.service: found {self._config.fleet.service!r}, but no map is kept; set "
                                  "service.state_dir or run under systemd")  # fmt: skip
        except CeilvoError as e:
            self._error = str(e)
            self._tell(self._error, logging.ERROR)
            yield
            return
        path = self._folder / MAP_NAME
        met = part.met_beside(self._config, path, _knew_its_place(self._folder), PATIENCE_S)
        if met is not None:
            self._hear(met, starting=True)
        self._take(sync, path)
        with part.part(self._config, path, self._knows_its_place, self._hear):
            yield

    def counters(self) -> dict[str, object]:
        """For the health message; nothing where there is no fleet."""
        if not self._config.fleet.service:
            return {}
        standing, contact_ns = self._standing, self._contact_ns
        out: dict[str, object] = {} if standing is None else asdict(standing)
        out["contact_age_s"] = None if contact_ns is None else 1e-9 * (time.monotonic_ns() - contact_ns)
        return {"fleet": out | {"error": self._error}}

    def _take(self, sync: Any, path: Path) -> None:
        try:
            said = sync.take_held(self._config, path)
            self._standing = sync.standing_of(path)
        except CeilvoError as e:
            self._tell(f"{e}; localisation goes on with the robot's own map", logging.WARNING)
        else:
            if said:
                self._tell(said, logging.INFO)

    def _hear(self, met: Met, starting: bool = False) -> None:
        """What came of a meeting; what was said before is not said again."""
        if met.standing is not None:
            self._standing = met.standing
        if met.reached:
            self._contact_ns = time.monotonic_ns()
        self._error = "" if met.reached else met.said
        said = met.said
        if met.newer and not starting and met.standing is not None:
            said = "; ".join(filter(None, (said, f"version {met.standing.newest} is here, the next start takes it")))
        if said and (met.is_news or said != self._said):
            self._tell(said, logging.INFO if met.reached else logging.WARNING)
        self._said = said

    def _tell(self, text: str, level: int) -> None:
        self._tell_event("fleet", f"fleet: {text}", level)

    def _knows_its_place(self) -> bool:
        last = self._last()
        return last is not None and last.state is State.TRACKING


def _knew_its_place(folder: Path) -> bool:
    """Whether the run before ended where it knew its place, so that what it learnt is worth an offer."""
    try:
        state = load_state(folder / STATE_NAME)
    except FileFormatError:
        return False
    return state is not None and state.state is State.TRACKING
