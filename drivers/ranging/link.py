"""The thread that listens to a radio module on a serial port; a module that is away is waited for."""

from __future__ import annotations

import logging
import termios
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import serial

from ceilvo.config import Beacons
from ceilvo.drivers.ports import Clock
from ceilvo.drivers.ranging import dwm1001
from ceilvo.drivers.ranging.mailbox import Mailbox
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.errors import RangingError

_log = logging.getLogger("ceilvo.ranging")

_QUIET_S = 1.2
"""A module whose lines are on says one in so long; lines that are off are switched on then, for the same command
switches them off."""
_WAKE_S = 1.0
"""The shell needs between the two returns and a command; chosen, the guide says that it takes up to a second."""
_SILENT_S = 3.0
"""Without a round for longer the module is asked again from the start."""
_ANSWER_S = 0.2
"""A binary module answers within; chosen: the guide's examples answer in some 20 ms."""
_RETRY_S = (0.2, 5.0)
"""First and longest wait before a port is opened again; it doubles."""
_LINE_BYTES = 1024
"""Longest line; one with 16 anchors has 700."""
_BITS = 10
"""Of a byte on the line, with start and stop."""
_WARNED_PER_S, _WARN_BURST = 0.2, 5
_JOIN_S = 1.0


@dataclass(frozen=True, slots=True)
class RangingSnapshot:
    """Rounds taken, damaged ones, times that the port was opened, and the last error."""

    up: bool = False
    rounds: int = 0
    damaged: int = 0
    opened: int = 0
    last_error: str = ""


class RangingLink:
    """Reads what a module says, in the protocol of the configuration, into a mailbox."""

    def __init__(
        self,
        settings: Beacons,
        mailbox: Mailbox,
        clock: Clock = time.monotonic_ns,
        on_crash: Callable[[BaseException], None] | None = None,
    ) -> None:
        """clock: of the stamps; on_crash: called in the thread when it dies."""
        self._settings, self._mailbox, self._clock, self._on_crash = settings, mailbox, clock, on_crash
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="ranging", daemon=True)
        self._warnings = QuietLog(_log, _WARNED_PER_S, _WARN_BURST)
        self._snapshot = RangingSnapshot()

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)

    def snapshot(self) -> RangingSnapshot:
        return self._snapshot

    def _run(self) -> None:
        try:
            self._loop()
        except Exception as e:
            if self._on_crash is None:
                raise
            self._on_crash(e)

    def _loop(self) -> None:
        wait_s = _RETRY_S[0]
        while not self._stopping.is_set():
            before = self._snapshot.rounds
            try:
                self._listen()
            except (RangingError, OSError, termios.error, ValueError) as e:
                c = self._settings
                hint = f"check beacons.port ({c.port}) and its permissions (group dialout)"
                self._fail(e if isinstance(e, RangingError) else RangingError(f"ranging port {c.port}: {e}; {hint}"))
            wait_s = _RETRY_S[0] if self._snapshot.rounds > before else min(2.0 * wait_s, _RETRY_S[1])
            self._stopping.wait(wait_s)

    def _listen(self) -> None:
        c = self._settings
        with serial.Serial(c.port, c.baud, timeout=0.1, exclusive=True) as port:
            self._snapshot = replace(self._snapshot, opened=self._snapshot.opened + 1)
            (self._ask if c.protocol == "tlv" else self._read_lines)(port)
        self._snapshot = replace(self._snapshot, up=False)

    def _read_lines(self, port: serial.Serial) -> None:
        """Until the port fails, the module is silent, or the end."""
        parse = dwm1001.les_line if self._settings.protocol == "les" else dwm1001.lec_line
        command = dwm1001.LES if self._settings.protocol == "les" else dwm1001.LEC
        heard_s, asked, rest = time.monotonic(), False, b""
        while not self._stopping.is_set():
            rest += port.read(max(1, port.in_waiting))
            *lines, rest = rest.replace(b"\r", b"\n").split(b"\n")
            rest = rest[-_LINE_BYTES:]
            for line in lines:
                if self._take(lambda line=line: parse(line.decode("ascii", "replace")), len(line)):  # type: ignore[misc]
                    heard_s = time.monotonic()
            silent_s = time.monotonic() - heard_s
            if not asked and silent_s > _QUIET_S:
                asked = True
                port.write(dwm1001.WAKE)
                self._stopping.wait(_WAKE_S)
                port.write(command)
                heard_s = time.monotonic()
            elif asked and silent_s > _SILENT_S:
                raise RangingError(self._silence())

    def _ask(self, port: serial.Serial) -> None:
        period_s, heard_s = 1.0 / self._settings.rate_hz, time.monotonic()
        while not self._stopping.is_set():
            due_s = time.monotonic() + period_s
            port.reset_input_buffer()
            port.write(dwm1001.LOC_GET)
            answer = self._answer(port)
            if answer and self._take(lambda answer=answer: dwm1001.tlv_answer(answer), len(answer)):  # type: ignore[misc]
                heard_s = time.monotonic()
            if time.monotonic() - heard_s > _SILENT_S:
                raise RangingError(self._silence())
            self._stopping.wait(due_s - time.monotonic())

    def _answer(self, port: serial.Serial) -> bytes:
        """A whole answer, or what came of one in the time that it has."""
        got, end_s = bytearray(), time.monotonic() + _ANSWER_S
        while time.monotonic() < end_s:
            got += port.read(max(1, port.in_waiting))
            try:
                size = dwm1001.tlv_size(bytes(got))
            except RangingError:
                return bytes(got)
            if size is not None and len(got) >= size:
                return bytes(got[:size])
        return bytes(got)

    def _take(self, parse: Callable[[], dwm1001.Measured | None], size: int) -> bool:
        """Whether it was a round; what is damaged is counted and told."""
        stamp_ns = self._clock() - round(1e9 * _BITS * size / self._settings.baud)
        try:
            measured = parse()
        except RangingError as e:
            self._snapshot = replace(self._snapshot, damaged=self._snapshot.damaged + 1)
            self._fail(e)
            return False
        if measured is None:
            return False
        self._mailbox.put(measured, stamp_ns)
        if not self._snapshot.up:
            _log.info("ranging module up on %s", self._settings.port)
        self._snapshot = replace(self._snapshot, up=True, rounds=self._snapshot.rounds + 1)
        return True

    def _silence(self) -> str:
        c = self._settings
        return (
            f"ranging port {c.port}: no round within {_SILENT_S:g} s; check that the module is a tag with anchors in "
            f"reach, {c.baud} baud, and beacons.protocol {c.protocol}"
        )

    def _fail(self, error: RangingError) -> None:
        text = str(error)
        if self._snapshot.up or text != self._snapshot.last_error:
            self._warnings.warning(text)
        self._snapshot = replace(self._snapshot, last_error=text)
