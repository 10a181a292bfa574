"""What pages show of a robot: its newest messages and a short history, fed by a thread of its own."""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Any

from ceilvo.config import Config
from ceilvo.drivers.bus import messages
from ceilvo.drivers.bus.command_guard import CommandGuard
from ceilvo.drivers.live.feed import ALIVE, GONE, Feed
from ceilvo.drivers.ports import ON_DEMAND, Topic
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.errors import BusError, one_line

log = logging.getLogger(__name__)

Message = str | bytes
"""A line of JSON, or a JPEG."""
_ALWAYS = (Topic.POSE, Topic.HEALTH, Topic.EVENT)
_SILENT_S = 2.0
"""Without a pose for longer the robot is silent; chosen: many frames of the slowest camera."""
_PATH_POINTS, _PATH_STEP_M = 1000, 0.05
_STATES, _EVENTS = 50, 50
"""Latest ones that a page gets."""
_LANDMARKS_S = {500: 1.0, 20_000: 5.0}
"""Between two looks at a map of fewer landmarks than that: the daemon makes the message from all of them."""
_LARGE_S = 60.0
"""At a larger one."""
_MOST_LANDMARKS = 20_000
"""That a page draws; of more every second, third, ..."""
_MOST_BYTES = 1 << 25
"""Of a message; the largest map is 20 MB."""
_TEXT_CHARS = 300
"""Of an event's text."""


class Robot:
    """Thread-safe: run() is for a thread of its own, all else for any."""

    def __init__(self, config: Config, clock: Callable[[], float] = time.monotonic) -> None:
        """
        Raises:
            BusError: Zenoh cannot be used as configured.
            ConfigError: a file cannot be used.
        """
        self.name = config.robot.name
        self._token = CommandGuard.of(config.zenoh).token
        self._feed = Feed(config.zenoh, config.robot.name, _ALWAYS)
        self._clock = clock
        self._quiet = QuietLog(log, 0.2, 5)
        self._lock = threading.Lock()
        self._told: dict[str, tuple[int, Message]] = {}
        self._number = 0
        self._wants: dict[object, frozenset[Topic]] = {}
        self._path: deque[tuple[float, float]] = deque(maxlen=_PATH_POINTS)
        self._map_id = ""
        self._states: deque[dict[str, object]] = deque(maxlen=_STATES)
        self._events: deque[dict[str, object]] = deque(maxlen=_EVENTS)
        self._alive, self._heard_s = False, -math.inf
        self._link: tuple[bool, bool] | None = None
        self._landmarks_due_s, self._landmarks_asked = -math.inf, False

    def run(self, stop: threading.Event, on_ready: Callable[[], None] = lambda: None) -> None:
        """Listen until `stop` is set.

        Raises:
            BusError: Zenoh cannot be used as configured.
        """
        with self._feed:
            on_ready()
            self._feed.each(stop, self._take, self._idle)

    @property
    def alive(self) -> bool:
        """Whether its daemon is there."""
        return self._alive

    def command(self, name: str, payload: bytes) -> tuple[bool, bytes] | None:
        """The daemon's reply to a command and whether it was done; None where nobody answers. Waits some seconds."""
        return self._feed.ask(f"cmd/{name}", payload, self._token)

    def want(self, page: object, topics: Collection[Topic]) -> None:
        """A page is open and needs these of what the daemon makes on demand."""
        with self._lock:
            self._wants[page] = frozenset(topics) & frozenset(ON_DEMAND)

    def leave(self, page: object) -> None:
        """A page is closed."""
        with self._lock:
            self._wants.pop(page, None)

    def news(self, seen: dict[str, int], topics: Collection[Topic]) -> list[Message]:
        """What a page has not seen yet, the newest of each kind; `seen` is the page's and brought up to date.

        Args:
            topics: of those made on demand, the ones that the page needs now.
        """
        left_out = {t.value for t in ON_DEMAND if t not in topics}
        with self._lock:
            out: list[Message] = [] if seen else [_line("path", {"xy_m": list(self._path)})]
            for name, (number, message) in self._told.items():
                if seen.get(name, 0) < number and name not in left_out:
                    seen[name] = number
                    out.append(message)
            seen.setdefault("path", 0)
            return out

    # -- in the thread of run()

    def _take(self, topic: str, payload: bytes) -> None:
        if topic in (ALIVE, GONE):
            self._alive = topic == ALIVE
            return
        try:
            if len(payload) > _MOST_BYTES:
                raise BusError(f"{topic} message: {len(payload)} bytes, expected at most {_MOST_BYTES}")
            self._keep(topic, payload)
        except BusError as e:
            self._quiet.warning(f"{e}; it is left out")

    def _keep(self, topic: str, payload: bytes) -> None:
        if topic == Topic.IMAGE.value:
            self._tell(topic, payload)
            return
        try:
            if topic == Topic.POSE.value:
                self._pose(messages.decode_pose(payload))
            elif topic == Topic.EVENT.value:
                self._event(messages.decode(payload, topic))
            elif topic == Topic.LANDMARKS.value:
                self._landmarks(messages.decode(payload, topic))
                return
            else:
                messages.decode(payload, topic)
        except (KeyError, TypeError, ValueError, OverflowError) as e:
            raise BusError(f"{topic} message: {type(e).__name__} {one_line(e)}") from e
        if topic != Topic.EVENT.value:
            self._tell(topic, f'{{"topic":"{topic}","data":{payload.decode("utf-8")}}}')

    def _pose(self, pose: messages.Pose) -> None:
        self._heard_s = self._clock()
        at, map_id = (pose.x_m, pose.y_m), str(pose.fields.get("map_id", ""))
        with self._lock:
            if map_id != self._map_id:
                self._map_id = map_id
                self._path.clear()
            known = math.isfinite(at[0] + at[1])
            if known and (not self._path or math.dist(at, self._path[-1]) > _PATH_STEP_M):
                self._path.append(at)
        last = self._states[-1]["state"] if self._states else None
        if pose.state.name != last:
            changed = {"stamp_unix_ns": pose.stamp_unix_ns, "state": pose.state.name, "reason": pose.reason}
            self._states.append(changed)
            self._tell("states", _line("states", list(self._states)))

    def _event(self, f: Mapping[str, Any]) -> None:
        words = {name: one_line(f[name], _TEXT_CHARS) for name in ("event", "severity", "text")}
        self._events.append({"stamp_unix_ns": int(f["stamp_unix_ns"]), **words})
        self._tell("events", _line("events", list(self._events)))

    def _landmarks(self, f: Mapping[str, Any]) -> None:
        """Positions to the millimetre, for a phone."""
        rows = list(zip(f["x_m"], f["y_m"], f["kind"], strict=True))
        shown = rows[:: max(1, -(-len(rows) // _MOST_LANDMARKS))]
        drawn = [[round(float(x), 3), round(float(y), 3), int(kind)] for x, y, kind in shown]
        self._landmarks_due_s = self._clock() + next((s for n, s in _LANDMARKS_S.items() if len(rows) < n), _LARGE_S)
        self._landmarks_asked = False
        self._tell("landmarks", _line("landmarks", {"count": len(rows), "rows": drawn}))

    def _idle(self) -> None:
        now_s = self._clock()
        link = (self._alive, now_s - self._heard_s > _SILENT_S)
        if link != self._link:
            self._link = link
            self._tell("link", _line("link", {"alive": link[0], "silent": link[1]}))
        with self._lock:
            topics = frozenset().union(*self._wants.values())
        if Topic.LANDMARKS in topics and not self._landmarks_asked and now_s < self._landmarks_due_s:
            topics -= {Topic.LANDMARKS}
        self._landmarks_asked = Topic.LANDMARKS in topics
        self._feed.want(topics)

    def _tell(self, name: str, message: Message) -> None:
        with self._lock:
            self._number += 1
            self._told[name] = self._number, message


def _line(topic: str, data: object) -> str:
    return json.dumps({"topic": topic, "data": data}, allow_nan=False, separators=(",", ":"))
