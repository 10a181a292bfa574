"""The recorder's thread: takes messages from everybody, never lets anybody wait, and stops itself when the disk does.

Whoever has something to record leaves it in a bounded queue; when the disk is too slow, messages are dropped and
counted. Encoding and compression happen in the thread.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from ceilvo.drivers.ports import Clock
from ceilvo.drivers.recording.mcap_file import Message

_log = logging.getLogger("ceilvo.recorder")

QUEUE_BYTES = 32 << 20
"""docs/recording.md: what comes while it is full is dropped and counted."""
QUEUE_ITEMS = 4096
"""So that many small messages are bounded too; chosen."""
_IDLE_S = 0.25
"""Between two looks of the writer at what is due."""
_RETRY_S = 30.0
"""Until a disk that refused is tried again."""
_DRAIN_S = 1.0
"""That closing waits for what is in the queue."""


class Storage(Protocol):
    """Where messages go. Used by one thread; every method may raise OSError, after which close() is called."""

    @property
    def due(self) -> bool:
        """A new file should begin as soon as somebody says from where it can be replayed."""

    @property
    def retries(self) -> bool:
        """Whether it is worth trying again after an OSError."""

    def write(self, message: Message) -> None: ...

    def begin(self, now_ns: int) -> None:
        """End the current file; what is written from now on goes to a new one."""

    def fault(self, reason: str, now_ns: int) -> None:
        """Something went wrong that people will want to look at."""

    def tick(self, now_ns: int) -> None:
        """Called before every write and several times a second: flush, look at the room that is left."""

    def close(self) -> None: ...

    def abandon(self) -> None:
        """Close without writing, after an OSError; never raises."""

    def bytes_written(self) -> int: ...


@dataclass(frozen=True, slots=True)
class RecorderCounters:
    """Since start().

    Attributes:
        messages: written.
        dropped: not written, because the disk was too slow or the recorder had stopped.
        bytes: on disk.
        faults: reported to it.
        stopped: why it records nothing at present; empty while it does.
        cpu_s: processor time of its thread.
    """

    messages: int = 0
    dropped: int = 0
    bytes: int = 0
    faults: int = 0
    stopped: str = ""
    cpu_s: float = 0.0


@dataclass(frozen=True, slots=True)
class _Item:
    messages: tuple[Message, ...] = ()
    size: int = 0
    begins: bool = False
    fault: str = ""


class Recorder:
    """Thread-safe; put(), begin() and fault() take microseconds and never raise."""

    def __init__(
        self,
        storage: Storage,
        clock: Clock,
        on_stop: Callable[[str], None] = lambda why: None,
        patience_s: float = 0.0,
    ) -> None:
        """
        Args:
            on_stop: called from the thread, once each time that recording stops by itself.
            patience_s: after its start the thread leaves the processor to others for so long, or until hurry() is
                called, there is a fault or the queue is half full.
        """
        self._storage, self._clock, self._on_stop = storage, clock, on_stop
        self._changed = threading.Condition()
        self._queue: deque[_Item] = deque()
        self._waiting_bytes = 0
        self._messages = self._dropped = self._faults = self._bytes = 0
        self._cpu_s = 0.0
        self._stopped = ""
        self._retry_ns: int | None = None
        self._due = False
        self._ending = False
        self._patience_s = patience_s
        self._hurry = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)

    @property
    def due(self) -> bool:
        """Whether begin() is wanted."""
        return self._due

    def counters(self) -> RecorderCounters:
        with self._changed:
            return RecorderCounters(
                self._messages, self._dropped, self._bytes, self._faults, self._stopped, self._cpu_s
            )

    def start(self) -> None:
        self._thread.start()

    def hurry(self) -> None:
        """Nothing more important is being done."""
        self._hurry.set()

    def put(self, *messages: Message, size: int = 0) -> None:
        """Messages that belong together: all of them are written, or all dropped. size: of what they hold, bytes."""
        self._add(_Item(messages, size), bounded=True)

    def begin(self, *messages: Message) -> None:
        """A new file starts with these, which say where a replay of it starts."""
        self._due = False
        self._add(_Item(messages, begins=True), bounded=False)

    def fault(self, reason: str) -> None:
        """Keep what is recorded around now."""
        self._add(_Item(fault=reason), bounded=False)

    def stop(self) -> bool:
        """Write what is waiting, for a second at most, and close; False when that took longer."""
        with self._changed:
            self._ending = True
            self._changed.notify()
        self._hurry.set()
        if self._thread.ident is not None:
            self._thread.join(_DRAIN_S)
        return not self._thread.is_alive()

    def _add(self, item: _Item, bounded: bool) -> None:
        with self._changed:
            full = self._waiting_bytes + item.size > QUEUE_BYTES or len(self._queue) >= QUEUE_ITEMS
            if self._ending or (bounded and (full or self._stopped)):
                self._dropped += len(item.messages)
                return
            self._queue.append(item)
            self._waiting_bytes += item.size
            self._faults += bool(item.fault)
            self._changed.notify()
            if item.fault or 2 * self._waiting_bytes > QUEUE_BYTES or 2 * len(self._queue) > QUEUE_ITEMS:
                self._hurry.set()

    # -- the thread

    def _run(self) -> None:
        self._hurry.wait(self._patience_s)
        try:
            while self._turn():
                pass
            with contextlib.suppress(OSError) if self._stopped else contextlib.nullcontext():
                self._storage.close()  # what it may not do once it has stopped is no news
            self._count_bytes()
        except Exception as e:  # recording must never take the robot's localisation down
            if not isinstance(e, OSError):
                _log.exception("the recorder failed")
            self._halt(e, retry=False)

    def _turn(self) -> bool:
        item = self._next()
        now_ns = self._clock()
        if self._stopped:
            self._maybe_resume(now_ns)
        if self._stopped:
            self._forget(item)
        else:
            try:
                self._do(item, now_ns)
            except OSError as e:
                self._forget(item)
                self._halt(e, retry=self._storage.retries)
        with self._changed:
            return bool(self._queue) or not self._ending

    def _next(self) -> _Item | None:
        with self._changed:
            if not self._queue and not self._ending:
                self._changed.wait(_IDLE_S)
            if not self._queue:
                return None
            item = self._queue.popleft()
            self._waiting_bytes -= item.size
            return item

    def _do(self, item: _Item | None, now_ns: int) -> None:
        self._storage.tick(now_ns)
        if item is not None:
            if item.begins:
                self._storage.begin(now_ns)
            for message in item.messages:
                self._storage.write(message)
            if item.fault:
                self._storage.fault(item.fault, now_ns)
        self._due = self._storage.due
        with self._changed:
            self._messages += 0 if item is None else len(item.messages)
        self._count_bytes()

    def _count_bytes(self) -> None:
        with self._changed:
            self._bytes, self._cpu_s = self._storage.bytes_written(), time.thread_time()

    def _forget(self, item: _Item | None) -> None:
        if item is not None:
            with self._changed:
                self._dropped += len(item.messages)

    def _halt(self, error: Exception, retry: bool) -> None:
        why = _reason(error)
        try:
            self._storage.abandon()
        except Exception:
            _log.exception("the recorder's file could not be closed")
        with self._changed:
            news, self._stopped = why != self._stopped, why
            self._dropped += sum(len(i.messages) for i in self._queue)
            self._queue.clear()
            self._waiting_bytes = 0
        self._retry_ns = self._clock() + int(_RETRY_S * 1e9) if retry else None
        if news:
            self._on_stop(why)

    def _maybe_resume(self, now_ns: int) -> None:
        if self._retry_ns is not None and now_ns >= self._retry_ns:
            try:
                self._storage.tick(now_ns)
            except OSError as e:
                self._halt(e, retry=True)
                return
            with self._changed:
                self._stopped = ""


def _reason(error: Exception) -> str:
    if isinstance(error, OSError):
        where = f" ({error.filename})" if error.filename else ""
        return f"{error.strerror or error}{where}"
    return f"{type(error).__name__}: {error}"
