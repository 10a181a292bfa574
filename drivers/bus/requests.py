"""What the daemon answers on the bus, whatever the bus: queries for data and commands that do something."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.drivers.bus import commands, messages
from ceilvo.drivers.bus.command_guard import CommandGuard
from ceilvo.drivers.ports import Clock, Stamp
from ceilvo.drivers.rate_limit import QuietLog, TokenBucket
from ceilvo.errors import BusError, CeilvoError
from ceilvo.types import Landmarks

log = logging.getLogger(__name__)

Result = Mapping[str, object]
"""What a command did, for the reply; plain values."""


def no_pose(asked: commands.PoseAt) -> bytes:
    """Where nobody estimates one."""
    raise BusError("no pose here; ask a robot that drives")


@dataclass(frozen=True, slots=True)
class Handlers:
    """The daemon's side of every request.

    They are called in threads of the bus, so they must be thread-safe towards the estimator (commands are called one at
    a time), and should return within a second: the caller waits. A CeilvoError becomes the error that the caller reads.
    """

    map: Callable[[], Landmarks]
    calibration: Callable[[], Calibration]
    config: Callable[[], Config]
    initial_pose: Callable[[commands.InitialPose], Result]
    relocalise: Callable[[commands.Relocalise], Result]
    save_map: Callable[[commands.SaveMap], Result]
    reset: Callable[[commands.Reset], Result]
    told: Callable[[str, str, str, str], None] = lambda command, arguments, who, outcome: None
    """Hears of every command that was taken, or refused for want of a right to it."""
    pose: Callable[[commands.PoseAt], bytes] = no_pose
    """The pose message, as it is or moved on."""


@dataclass(frozen=True, slots=True)
class Answer:
    """ok False is sent as an error reply; the payload is JSON either way."""

    ok: bool
    payload: bytes


class Requests:
    """Answers requests by name ("map", "cmd/reset") and counts them."""

    COMMANDS_PER_S, COMMAND_BURST = 5.0, 20
    """A flood of commands must neither keep the estimator from its frames nor the disk busy."""
    LOGGED_PER_S, LOG_BURST = 0.2, 20
    """Refusals in the log: 20 at once, then one in 5 s with the number left out (docs/faults.md)."""

    NAMES: tuple[str, ...] = (*messages.QUERIES, *(f"cmd/{c}" for c in commands.COMMANDS))

    def __init__(
        self,
        robot: str,
        handlers: Handlers,
        clock: Clock = time.monotonic_ns,
        guard: CommandGuard | None = None,
    ) -> None:
        self._robot, self._guard = robot, guard or CommandGuard()
        self._allowed = TokenBucket(self.COMMANDS_PER_S, self.COMMAND_BURST, clock)
        self._strangers = TokenBucket(self.LOGGED_PER_S, self.LOG_BURST, clock)
        self._refusals = QuietLog(log, self.LOGGED_PER_S, self.LOG_BURST, clock)
        self._handlers = handlers
        self._command_lock = threading.Lock()
        self._count_lock = threading.Lock()
        self._counts = {"queries": 0, "commands": 0, "request_errors": 0}

    def answer(self, name: str, payload: bytes, attachment: bytes = b"", *, exact: bool = True) -> Answer:
        """Carry out one request; never raises.

        Args:
            attachment: the owner's token, for commands that need one.
            exact: False when the request was for many keys (a wildcard): commands are then refused, because reading
                everything must not reset a robot.
        """
        short_name = name.removeprefix("cmd/")
        is_command = name != short_name
        try:
            body = self._command(short_name, payload, attachment, exact) if is_command else self._query(name, payload)
        except CeilvoError as e:
            self._refusals.warning(f"{name} refused: {e}")
            return self._count("request_errors", Answer(False, messages.encode_error(self._robot, short_name, str(e))))
        except Exception as e:
            # A fault in a handler must reach the caller as an answer: a query without one hangs until its timeout.
            log.exception("%s failed", name)
            text = f"internal error {type(e).__name__}; see the daemon's log"
            return self._count("request_errors", Answer(False, messages.encode_error(self._robot, short_name, text)))
        return self._count("commands" if is_command else "queries", Answer(True, body))

    def counters(self) -> dict[str, int]:
        with self._count_lock:
            return dict(self._counts)

    def _count(self, name: str, answer: Answer) -> Answer:
        with self._count_lock:
            self._counts[name] += 1
        return answer

    def _query(self, name: str, payload: bytes) -> bytes:
        h = self._handlers
        if name == "pose":
            return h.pose(commands.parse_pose_at(payload))
        if name == "calibration":
            return messages.encode_calibration(self._robot, h.calibration())
        if name == "config":
            return messages.encode_config(self._robot, h.config())
        stamp = Stamp(time.monotonic_ns(), time.time_ns())
        return messages.encode_map(self._robot, stamp, h.map())

    def _command(self, name: str, payload: bytes, attachment: bytes, exact: bool) -> bytes:
        request = commands.parse_command(name, payload, exact=exact)
        arguments = payload.decode(errors="replace")
        try:  # before the rate is counted: strangers must not use up the owner's
            who = self._guard.admit(name, attachment)
        except BusError as e:
            if self._strangers.take():
                self._handlers.told(name, arguments, "somebody", f"refused: {e}")
            raise
        if not self._allowed.take():
            raise BusError(
                f"command {name}: more than {self.COMMANDS_PER_S:g} commands per second, nothing was done; try again"
            )
        try:
            with self._command_lock:
                result = self._dispatch(request)
        except CeilvoError as e:
            self._handlers.told(name, arguments, who, f"failed: {e}")
            raise
        log.info("command %s by %s: %s", name, who, dict(result))
        self._handlers.told(name, arguments, who, "done")
        return messages.encode_reply(self._robot, name, result)

    def _dispatch(self, request: commands.Command) -> Result:
        h = self._handlers
        if isinstance(request, commands.InitialPose):
            return h.initial_pose(request)
        if isinstance(request, commands.Relocalise):
            return h.relocalise(request)
        if isinstance(request, commands.SaveMap):
            return h.save_map(request)
        return h.reset(request)
