"""The thread that keeps the base informed, with a mailbox of one: a slow or dead line never holds the estimate."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from ceilvo import config
from ceilvo.config.serial_budget import wire_budget
from ceilvo.drivers.base.protocol import no_estimate, telegram_of
from ceilvo.drivers.base.wheel_track import WheelTrack
from ceilvo.drivers.ports import Base, Clock
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.errors import BaseLinkError
from ceilvo.senses.prediction import predicted
from ceilvo.types import GOOD, Estimate, State

_log = logging.getLogger("ceilvo.base")

_BACKOFF_MIN_S = 0.05
"""First wait before a lost port is opened again; it doubles up to base.reconnect_max_s (docs/base-protocol.md)."""
_FAILURES_BEFORE_REOPENING = 5
"""Telegrams in a row without an answer (docs/base-protocol.md)."""
_JOIN_S = 1.0
"""That stopping waits for an exchange that hangs; chosen."""
_WARN_PERIOD_S = 5.0
"""Between two warnings of one link."""
_WARNED_PER_S, _WARN_BURST = 0.2, 10
"""A link that comes and goes must not fill the log."""


@dataclass(frozen=True, slots=True)
class LinkSnapshot:
    """Counters of the link at one moment.

    Attributes:
        up: the last telegram was answered.
        telegrams_sent: answered ones.
        telegrams_failed: sent without a proper answer. While the port is closed nothing is sent.
        reconnects: times the port was opened again after the first.
        last_error: most recent failure, kept after recovery; empty before the first.
        link_age_s: time since the last answer, None before the first.
        status: the last answer.
    """

    up: bool = False
    telegrams_sent: int = 0
    telegrams_failed: int = 0
    reconnects: int = 0
    last_error: str = ""
    link_age_s: float | None = None
    status: BaseStatus | None = None


class BaseLink:
    """Sends the newest estimate at the configured rate and collects wheel odometry.

    Without a new estimate the last one is sent again with its age grown; the heartbeat shows that this process lives,
    the age whether its estimates do. Before the first estimate the state is INIT.
    """

    def __init__(
        self,
        settings: config.Base,
        base: Base,
        clock: Clock = time.monotonic_ns,
        on_crash: Callable[[BaseException], None] | None = None,
        seamless: bool = False,
    ) -> None:
        """clock must be the one of the estimates' stamps; on_crash is called in the thread when it dies; seamless is
        WheelTrack's."""
        self._settings = settings
        self._base = base
        self._clock = clock
        self._on_crash = on_crash
        self._status_response_ns = round(1e9 * wire_budget(settings).status_response_s)
        self._wheels = WheelTrack(seamless=seamless)
        self._latest: Estimate | None = None
        self._final_state: State | None = None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="base", daemon=True)
        # Written by the thread only and replaced whole, so that readers need no lock.
        self._snapshot = LinkSnapshot()
        self._answered_ns: int | None = None
        self._heartbeat = 0
        self._opened = 0
        self._failures_in_row = 0
        self._warned_s = -math.inf
        self._warnings = QuietLog(_log, _WARNED_PER_S, _WARN_BURST)
        self._said_up = QuietLog(_log, _WARNED_PER_S, _WARN_BURST)

    @property
    def wheels(self) -> WheelTrack:
        """Wheel odometry so far; stays empty when base.use_wheels is off."""
        return self._wheels

    def start(self) -> None:
        self._thread.start()

    def submit(self, estimate: Estimate) -> None:
        """Never blocks; an estimate not yet sent is replaced."""
        self._latest = estimate

    def stop(self, final_state: State = State.STOPPED) -> bool:
        """Send a last telegram with final_state when the port is open, and end; False if that took longer than 1 s."""
        self._final_state = final_state
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)
        return not self._thread.is_alive()

    def snapshot(self) -> LinkSnapshot:
        answered_ns = self._answered_ns
        age_s = None if answered_ns is None else 1e-9 * (self._clock() - answered_ns)
        return replace(self._snapshot, link_age_s=age_s)

    def _run(self) -> None:
        try:
            self._loop()
            self._say_goodbye()
        except Exception as e:
            if self._on_crash is None:
                raise
            self._on_crash(e)
        finally:
            self._base.close()

    def _loop(self) -> None:
        period_s = 1.0 / self._settings.rate_hz
        backoff_s = _BACKOFF_MIN_S
        due_s = time.monotonic()
        while not self._stopping.is_set():
            if not self._base.is_open and not self._open():
                self._stopping.wait(backoff_s)
                backoff_s = min(2.0 * backoff_s, self._settings.reconnect_max_s)
                continue
            if self._send(self._telegram()):
                backoff_s = _BACKOFF_MIN_S
            # A line that fell behind goes on from now: never a burst.
            due_s = max(due_s + period_s, time.monotonic())
            self._stopping.wait(due_s - time.monotonic())

    def _say_goodbye(self) -> None:
        for _ in range(2):
            if not self._base.is_open or self._send(self._telegram()):
                return

    def _open(self) -> bool:
        try:
            self._base.open()
        except BaseLinkError as e:
            self._note_failure(e, telegrams=0)
            return False
        self._failures_in_row = 0
        self._opened += 1
        self._snapshot = replace(self._snapshot, reconnects=self._opened - 1)
        return True

    def _telegram(self) -> PoseTelegram:
        self._heartbeat = (self._heartbeat + 1) & 0xFFFF
        estimate = self._latest
        now_ns = self._clock()
        telegram = no_estimate(self._heartbeat) if estimate is None else self._told(estimate, now_ns)
        telegram = replace(telegram, version=self._settings.protocol)
        if telegram.state in GOOD and telegram.age_s > self._settings.stale_s:
            telegram = replace(telegram, state=State.DEAD_RECKONING, quality=0.0)
        if self._final_state is None:
            return telegram
        return replace(telegram, state=self._final_state, quality=0.0)

    def _told(self, estimate: Estimate, now_ns: int) -> PoseTelegram:
        """As the estimate is, or as it should be at now_ns."""
        ahead_s = 0.0
        if self._settings.predict:
            wheels = self._wheels.aside(estimate.stamp_ns, now_ns)
            pose, cov, ahead_s = predicted(estimate, now_ns, wheels)
            estimate = replace(estimate, pose=pose, cov=cov)
        return replace(telegram_of(estimate, now_ns, self._heartbeat), predicted_s=ahead_s)

    def _send(self, telegram: PoseTelegram) -> bool:
        try:
            status = self._base.exchange(telegram)
        except BaseLinkError as e:
            self._note_failure(e, telegrams=1)
            self._failures_in_row += 1
            if self._failures_in_row >= _FAILURES_BEFORE_REOPENING:
                self._failures_in_row = 0
                self._base.close()
            return False
        self._note_answer(status)
        return True

    def _note_answer(self, status: BaseStatus) -> None:
        now_ns = self._clock()
        if not self._snapshot.up:
            self._said_up.info(f"base link up on {self._settings.port}")
        if self._settings.use_wheels:
            self._wheels.add(status, now_ns - self._status_response_ns)
        self._failures_in_row = 0
        self._answered_ns = now_ns
        sent = self._snapshot.telegrams_sent + 1
        self._snapshot = replace(self._snapshot, up=True, telegrams_sent=sent, status=status)

    def _note_failure(self, error: BaseLinkError, telegrams: int) -> None:
        now_s = time.monotonic()
        changed = str(error) != self._snapshot.last_error and now_s - self._warned_s > _WARN_PERIOD_S
        if self._snapshot.up or changed:
            self._warned_s = now_s
            self._warnings.warning(f"base link: {error}")
        failed = self._snapshot.telegrams_failed + telegrams
        self._snapshot = replace(self._snapshot, up=False, telegrams_failed=failed, last_error=str(error))
