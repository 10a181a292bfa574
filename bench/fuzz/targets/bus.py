"""What comes over Zenoh: commands to the daemon, and what `ceilvod watch` prints of any robot."""

from __future__ import annotations

import copy
import io
import itertools
from functools import lru_cache
from random import Random

from ceilvo.bench.fuzz.engine.mutations import mutated_json
from ceilvo.bench.fuzz.engine.target import PERIOD_NS, Target, crossings, pipeline, rig, wheels
from ceilvo.config import Config
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.app.requests import handlers
from ceilvo.daemon.map.kept.store import Store
from ceilvo.daemon.replay.inputs import Sighting, apply
from ceilvo.drivers.bus import messages
from ceilvo.drivers.bus.command_guard import CommandGuard
from ceilvo.drivers.bus.commands import COMMANDS, parse_command
from ceilvo.drivers.bus.requests import Answer, Requests
from ceilvo.drivers.bus.watch import WatchOptions, _Printer
from ceilvo.types import Estimate

_TOKEN = b"0123456789abcdef"
_TOPICS = ("pose", "event", "health", "other")
_VIEWS = 4
"""Before a command comes, so that there is a map."""


def _command(data: bytes) -> None:
    if data:
        parse_command(COMMANDS[data[0] % len(COMMANDS)], data[1:])


class _Daemon:
    """A daemon's side of the bus, with a map and a pose, the same before every request."""

    def __init__(self) -> None:
        self.pipeline = pipeline()
        estimator = Estimator(self.pipeline, lambda: 0)
        served = handlers(Config(), rig(), estimator, Store(None, 0), lambda: False)
        clock = itertools.count(0, 10**9).__next__  # a second a look, so that no command is one too many
        self.requests = Requests("r", served, clock, CommandGuard(_TOKEN))
        for k in range(_VIEWS):
            self.last = self.look(k)
        self._state = copy.deepcopy(self.pipeline.state)

    def ask(self, name: str, payload: bytes, token: bytes, exact: bool) -> Answer:
        self.pipeline.state = copy.deepcopy(self._state)
        return self.requests.answer(name, payload, token, exact=exact)

    def look(self, k: int) -> Estimate:
        estimate = apply(self.pipeline, Sighting((k + 1) * PERIOD_NS, crossings(k), wheels()))
        assert estimate is not None
        return estimate


@lru_cache
def _daemon() -> _Daemon:
    return _Daemon()


def _request(data: bytes) -> None:
    """First byte: which request. Up to an empty line the payload, then the token; the robot then goes on."""
    payload, _, token = data[1:].partition(b"\n\n")
    names = (*Requests.NAMES, "cmd/none", "nothing")
    name = names[(data[0] if data else 0) % len(names)]
    answer = _daemon().ask(name, payload, token, not payload.startswith(b"*"))
    if b"internal error" in answer.payload:
        raise AssertionError(f"{name}: {answer.payload[:200]!r}")
    for k in (_VIEWS, _VIEWS + 1):
        messages.encode_pose("r", _daemon().look(k), 1, 2)


def _pose_message(data: bytes) -> None:
    messages.decode_pose(data)


def _watch(data: bytes) -> None:
    """First byte: topic, and whether as it comes; then the message."""
    first, payload = (data[0], data[1:]) if data else (0, b"")
    for raw in (False, True):
        out = io.StringIO()
        printer = _Printer(out, WatchOptions(raw=raw), lambda: 0.0)
        printer.message(f"ceilvo/{payload[:5].hex()}/{_TOPICS[first % len(_TOPICS)]}", payload)
        out.getvalue().encode("utf-8")


def _pose() -> bytes:
    return messages.encode_pose("r", _daemon().last, 1, 2)


def _watched() -> tuple[bytes, ...]:
    event = b'\1{"schema": "ceilvo.event.1", "robot": "r", "severity": "info", "event": "state", "text": "x"}'
    health = b'\2{"schema": "ceilvo.health.1", "robot": "r", "uptime_s": 4.5, "counters": {"frames": 7}}'
    return (b"\0" + _pose(), event, health)


def _prefixed(data: bytes, rng: Random) -> bytes:
    """The first byte chooses, the rest is JSON."""
    first = bytes([rng.randrange(256)]) if rng.random() < 0.05 else data[:1]
    return first + mutated_json(data[1:], rng)


_INITIAL = b'{"x_m": 1.0, "y_m": -2.5, "theta_rad": 0.5, "sigma_m": 0.1}'

TARGETS = {
    "command": Target(_command, lambda: (b"\0" + _INITIAL, b"\1{}", b"\2", b'\3{"keep_map": true}'), _prefixed),
    "request": Target(
        _request,
        lambda: tuple(
            bytes([Requests.NAMES.index(f"cmd/{name}")]) + payload + b"\n\n" + _TOKEN
            for name, payload in zip(COMMANDS, (_INITIAL, b"{}", b"", b'{"keep_map": true}'), strict=True)
        ),
    ),
    "pose_message": Target(_pose_message, lambda: (_pose(),), mutated_json),
    "watch": Target(_watch, _watched, _prefixed),
}
