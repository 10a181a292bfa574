"""Telling systemd how the service is: READY, WATCHDOG, STATUS, STOPPING (sd_notify(3), without libsystemd)."""

from __future__ import annotations

import logging
import os
import re
import socket
import time
from collections.abc import Callable, Mapping
from types import TracebackType

log = logging.getLogger(__name__)

SEND_TIMEOUT_S = 0.5
"""Longest that a message to systemd may block."""
STATUS_MAX_CHARS = 500
"""Of the line that `systemctl status` shows."""
FEEDS_PER_PERIOD = 4
"""Of the watchdog: sd_watchdog_enabled(3) recommends two; with four, late ones do not kill the daemon."""


class Notifier:
    """Datagrams to $NOTIFY_SOCKET; does nothing where systemd did not start the process.

    No method raises or blocks for longer than SEND_TIMEOUT_S: a sick service manager must not stop the robot. The
    first failure is logged. Safe to call from several threads.

    Attributes:
        watchdog_period_s: silence after which systemd kills the process, None when it watches nothing.
    """

    def __init__(
        self,
        environ: Mapping[str, str] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        env = os.environ if environ is None else environ
        self.watchdog_period_s = _watchdog_period_s(env)
        self._clock = clock
        self._last_feed_ns: int | None = None
        self._last_status = ""
        self._failed = False
        self._socket = self._connect(env.get("NOTIFY_SOCKET", ""))

    @property
    def active(self) -> bool:
        """Whether somebody listens."""
        return self._socket is not None

    def ready(self, status: str = "") -> None:
        """Start-up is complete; units ordered after this one may start."""
        self._send("READY=1" + (f"\nSTATUS={_one_line(status)}" if status else ""))

    def watchdog(self) -> None:
        """One more step was completed. Thinned out, so that it can be called for every frame."""
        if self._socket is None or self.watchdog_period_s is None:
            return
        now_ns = self._clock()
        due_ns = int(self.watchdog_period_s * 1e9 / FEEDS_PER_PERIOD)
        if self._last_feed_ns is None or now_ns - self._last_feed_ns >= due_ns:
            self._last_feed_ns = now_ns
            self._send("WATCHDOG=1")

    def status(self, text: str) -> None:
        """One line for `systemctl status`; sent only when it differs from the last."""
        line = _one_line(text)
        if line != self._last_status:
            self._last_status = line
            self._send(f"STATUS={line}")

    def stopping(self, status: str = "") -> None:
        """An orderly shutdown has begun."""
        self._send("STOPPING=1" + (f"\nSTATUS={_one_line(status)}" if status else ""))

    def close(self) -> None:
        """Idempotent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def __enter__(self) -> Notifier:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _connect(self, address: str) -> socket.socket | None:
        if not address:
            return None
        if address[0] not in "/@":
            self._warn(f"NOTIFY_SOCKET: found '{address}', expected a path or an abstract name (@...)")
            return None
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        sock.settimeout(SEND_TIMEOUT_S)
        try:
            sock.connect("\0" + address[1:] if address[0] == "@" else address)
        except OSError as e:
            sock.close()
            self._warn(f"NOTIFY_SOCKET {address}: {e.strerror or e}")
            return None
        return sock

    def _send(self, message: str) -> None:
        sock = self._socket
        if sock is None:
            return
        try:
            sock.send(message.encode())
        except OSError as e:
            self._warn(f"systemd did not take '{message.splitlines()[0]}': {e}")

    def _warn(self, text: str) -> None:
        if not self._failed:
            self._failed = True
            log.warning("%s; systemd will not hear from this process", text)


def _watchdog_period_s(env: Mapping[str, str]) -> float | None:
    """$WATCHDOG_USEC when it is meant for this process (sd_watchdog_enabled(3))."""
    usec, pid = env.get("WATCHDOG_USEC", ""), env.get("WATCHDOG_PID", "")
    if not re.fullmatch("[0-9]{1,18}", usec) or int(usec) == 0 or (pid and pid != str(os.getpid())):
        return None
    return int(usec) / 1e6


def _one_line(text: str) -> str:
    return " ".join(text.split())[:STATUS_MAX_CHARS]
