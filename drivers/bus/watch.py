"""What any Zenoh subscriber gets, as text: one line a pose, plain enough for a pipe. Behind `ceilvod watch`."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import queue
import textwrap
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TextIO

import zenoh

from ceilvo.config import Zenoh
from ceilvo.drivers.bus import messages
from ceilvo.drivers.bus.zenoh_session import Connection, watcher_config
from ceilvo.drivers.ports import Topic
from ceilvo.errors import BusError, printable
from ceilvo.types import State

log = logging.getLogger(__name__)

_POLL_S = 0.1
"""How soon Ctrl-C is noticed."""
_HEALTH_PERIOD_S = 10.0
"""Between two lines of a robot's health: it is long and changes slowly."""
_LINE = 120
"""Characters of a line for people; a longer one goes on, indented, on the next. JSON stays one line."""
_SILENCE_S = 3.0
"""Without any message after which it is said that nobody is there; chosen: poses come many times a second."""
_BACKLOG = 10_000
"""Messages kept for a slow terminal; more are dropped."""


@dataclass(frozen=True)
class WatchOptions:
    """How to print.

    Attributes:
        raw: every message as it came, one JSON object a line, without a rate limit.
        count: end after this many poses were printed; None = never.
        rate_hz: most pose lines a second and robot; a change of state is always printed.
    """

    raw: bool = False
    count: int | None = None
    rate_hz: float = 5.0


def watch(
    config: Zenoh,
    robot: str,
    out: TextIO,
    stop: threading.Event,
    options: WatchOptions | None = None,
    *,
    clock: Callable[[], float] = time.monotonic,
    on_ready: Callable[[], None] | None = None,
) -> int:
    """Print what a robot, or with "*" every robot, publishes until `stop` is set, `count` is reached or the reader of
    `out` has gone.

    Args:
        clock: seconds, monotonic; for the rate limit.
        on_ready: called when the subscriptions stand.

    Returns:
        Poses printed.

    Raises:
        BusError: Zenoh cannot be used as configured.
    """
    stem = f"{config.prefix}/*" if robot == "*" else messages.robot_key(config.prefix, robot)
    inbox: queue.Queue[tuple[str, bytes | None]] = queue.Queue(_BACKLOG)
    printer = _Printer(out, options or WatchOptions(), clock)

    def receive(sample: zenoh.Sample) -> None:
        with contextlib.suppress(queue.Full):
            inbox.put_nowait((str(sample.key_expr), sample.payload.to_bytes()))

    def alive(sample: zenoh.Sample) -> None:
        word = "appeared" if sample.kind == zenoh.SampleKind.PUT else "disappeared"
        with contextlib.suppress(queue.Full):
            inbox.put_nowait((f"{sample.key_expr}/{word}", None))

    others: set[str] = set()

    def other(sample: zenoh.Sample) -> None:
        name = str(sample.key_expr).rpartition("/")[2]
        (others.add if sample.kind == zenoh.SampleKind.PUT else others.discard)(name)

    held: list[object] = []

    def declare(session: zenoh.Session) -> None:
        for topic in (Topic.POSE, Topic.HEALTH, Topic.EVENT):
            held.append(session.declare_subscriber(f"{stem}/{topic.value}", receive))
        held.append(session.liveliness().declare_subscriber(stem, alive, history=True))
        held.append(session.liveliness().declare_subscriber(f"{config.prefix}/*", other, history=True))
        if on_ready is not None:
            on_ready()

    key = "zenoh.config_file" if config.config_file else "zenoh.listen"
    connection = Connection(watcher_config(config), key, declare)
    try:
        connection.open()
        _print_all(inbox, printer, stop, lambda: _nobody(config, robot, others))
    except BrokenPipeError:
        log.debug("the reader has gone")
    finally:
        connection.close()
    return printer.poses


def _nobody(config: Zenoh, robot: str, others: set[str]) -> str:
    """Why nothing is printed, as far as can be told."""
    who = f"no robot under {config.prefix}/" if robot == "*" else f"robot {robot!r}"
    there = ", ".join(sorted(others))
    hint = f"there are {there}" if there else "does ceilvod run, on this computer or reached by --config's zenoh keys?"
    return f"nothing heard from {who} for {_SILENCE_S:g} s; {hint}; waiting"


def _print_all(
    inbox: queue.Queue[tuple[str, bytes | None]],
    printer: _Printer,
    stop: threading.Event,
    nobody: Callable[[], str],
) -> None:
    silent = 0
    while not stop.is_set() and not printer.done:
        try:
            key, payload = inbox.get(timeout=_POLL_S)
        except queue.Empty:
            silent += silent >= 0
            if silent * _POLL_S >= _SILENCE_S:
                log.warning("%s", nobody())
                silent = -1  # once
            continue
        silent = -1
        printer.message(key, payload)


class _Printer:
    """Turns messages into lines; a message that is not ours becomes a line that says so."""

    def __init__(self, out: TextIO, options: WatchOptions, clock: Callable[[], float]) -> None:
        self._out = out
        self._options = options
        self._clock = clock
        self._last: dict[tuple[str, str], float] = {}
        self._state: dict[str, State] = {}
        self.poses = 0

    @property
    def done(self) -> bool:
        return self._options.count is not None and self.poses >= self._options.count

    def message(self, key: str, payload: bytes | None) -> None:
        robot, _, topic = key.rpartition("/")
        robot = robot.rpartition("/")[2]
        is_pose = topic == "pose"
        try:
            line = self._alive(robot, topic) if payload is None else self._line(robot, topic, payload)
        except BusError as e:
            line, is_pose = f"{robot} {e}", False
        if line is not None:
            text = printable(line)
            if not self._options.raw and len(text) > _LINE:
                text = textwrap.fill(text, _LINE, subsequent_indent="    ", drop_whitespace=True)
            self._out.write(text + "\n")
            self._out.flush()
            self.poses += is_pose

    def _alive(self, robot: str, word: str) -> str:
        if self._options.raw:
            return json.dumps({"robot": robot, "liveliness": word})
        return f"{robot} {word}"

    def _line(self, robot: str, topic: str, payload: bytes) -> str | None:
        fields = messages.decode(payload, topic)
        if topic == "pose":
            return self._pose(robot, payload, fields)
        if self._options.raw:
            return json.dumps(fields, separators=(",", ":"))
        if topic == "event":
            return f"{robot} {fields.get('severity')}: {fields.get('event')}: {fields.get('text')}"
        return self._health(robot, fields)

    def _pose(self, robot: str, payload: bytes, fields: Mapping[str, Any]) -> str | None:
        pose = messages.decode_pose(payload)
        if not self._options.raw:
            changed = self._state.get(robot) is not pose.state
            self._state[robot] = pose.state
            if not self._due((robot, "pose"), 1.0 / self._options.rate_hz) and not changed:
                return None
        return json.dumps(fields, separators=(",", ":")) if self._options.raw else pose_line(pose)

    def _health(self, robot: str, fields: Mapping[str, Any]) -> str | None:
        if not self._due((robot, "health"), _HEALTH_PERIOD_S):
            return None
        counters = fields.get("counters")
        text = " ".join(f"{k}={v}" for k, v in counters.items()) if isinstance(counters, dict) else ""
        return f"{robot} health: up {fields.get('uptime_s')} s {text}"

    def _due(self, what: tuple[str, str], period_s: float) -> bool:
        now = self._clock()
        if now - self._last.get(what, -math.inf) < period_s:
            return False
        self._last[what] = now
        return True


def pose_line(p: messages.Pose) -> str:
    """One pose for people: metres, degrees, millimetres of sigma."""
    sigma_mm = 1e3 * math.sqrt(max(p.cov[0] + p.cov[4], 0.0)) if math.isfinite(p.cov[0] + p.cov[4]) else math.nan
    sigma_deg = math.degrees(math.sqrt(max(p.cov[8], 0.0))) if math.isfinite(p.cov[8]) else math.nan
    text = (
        f"{p.robot} {p.seq:7d} {p.state.name:<14} x {p.x_m:+8.3f} y {p.y_m:+8.3f} m  "
        f"{math.degrees(p.theta_rad):+7.2f} deg  sigma {sigma_mm:6.1f} mm {sigma_deg:5.2f} deg  "
        f"q {p.quality:.2f}  {p.age_ms:5.1f} ms"
    )
    return f"{text}  {p.reason}" if p.reason else text
