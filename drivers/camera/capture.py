"""The capture thread: newest frame wins, every n-th on a busy computer; a lost camera is reopened; all is counted."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from ceilvo.config import Camera as CameraConfig
from ceilvo.drivers.camera.frame_rate import FrameRate
from ceilvo.drivers.ports import Camera, CameraInfo, Clock
from ceilvo.errors import BadFrameError, CameraError
from ceilvo.types import Frame

_RING = 8
"""Pictures that a new one is compared with; chosen: drivers have 2 to 8 buffers."""

EventKind = Literal["opened", "note", "lost", "bad_frame", "slow", "rate", "finished"]


@dataclass(frozen=True, slots=True)
class CaptureEvent:
    """Something worth a line in the log.

    opened: frames come (first time or again); note: the camera is not quite as asked; lost: no frames until further
    notice; bad_frame: the first unusable frame after good ones; slow: it gives fewer frames than it said; rate: fewer
    of them are used, since the computer is slow; finished: the recording ended.
    """

    kind: EventKind
    text: str


@dataclass(frozen=True, slots=True)
class CaptureCounters:
    """Since start().

    Attributes:
        frames: good ones read from the camera.
        drops: good ones that a newer one replaced before they were taken.
        skipped: good ones that were left out because only every n-th is used.
        bad_frames: cut short, of the wrong size, or with an unusable stamp.
        bad_stamps: those of them whose stamp did not increase.
        repeats: those of them whose picture was one of the last ones again.
        losses: times that the camera was lost.
        reopens: times that it came back.
        last_error: the newest problem, "" when there was none.
        connected: frames come.
    """

    frames: int = 0
    drops: int = 0
    skipped: int = 0
    bad_frames: int = 0
    bad_stamps: int = 0
    repeats: int = 0
    losses: int = 0
    reopens: int = 0
    last_error: str = ""
    connected: bool = False


class CaptureLoop:
    """Reads a camera in its own thread into a mailbox of one.

    A live camera's frame that nobody took is replaced by the next one; where that happens all the time, every n-th is
    used (FrameRate). A recording waits until its frame was taken, so nothing is dropped and a replay is repeatable.
    seq increases strictly over reopenings, stamps too; the size stays what it was at first. on_event and on_crash are
    called from the thread.

    Args:
        clock: CLOCK_MONOTONIC, for how long no good frame came, and how long whoever takes frames is busy with one.
        on_crash: called with whatever is no CameraError (FileFormatError of a damaged recording, programming errors),
            after which the loop ends.
    """

    def __init__(
        self,
        camera: Camera,
        settings: CameraConfig,
        clock: Clock,
        on_event: Callable[[CaptureEvent], None] = lambda _: None,
        on_crash: Callable[[Exception], None] = lambda _: None,
    ) -> None:
        self._camera, self._cfg, self._clock = camera, settings, clock
        self._on_event, self._on_crash = on_event, on_crash
        self._stopping = threading.Event()
        self._mail = threading.Condition()
        self._frame: Frame | None = None
        self._ended = False
        self._finished = False
        self._counters = CaptureCounters()
        self.rate = FrameRate(settings.rate_hz)
        self._taken_ns: int | None = None
        self._info: CameraInfo | None = None
        self._last: Frame | None = None
        self._pictures: deque[int] = deque(maxlen=_RING)
        self._seq_offset = 0
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)

    @property
    def info(self) -> CameraInfo | None:
        """Of the last successful opening; None before the first."""
        return self._info

    @property
    def finished(self) -> bool:
        """The recording ended and its last frame was taken."""
        with self._mail:
            return self._finished and self._frame is None

    def counters(self) -> CaptureCounters:
        return self._counters

    def start(self) -> None:
        self._thread.start()

    def take(self, timeout_s: float) -> Frame | None:
        """The newest frame, each at most once; None when none came in time or none will come any more.

        Whoever calls it is taken to have been busy with the last frame since.
        """
        with self._mail:
            if self._taken_ns is not None:
                self.rate.stepped(1e-9 * (self._clock() - self._taken_ns))
                self._taken_ns = None
            self._mail.wait_for(lambda: self._is_due() or self._ended, timeout_s)
            if not (self._is_due() or self._ended):
                return None
            frame, self._frame = self._frame, None
            if frame is not None:
                self.rate.used(frame.stamp_ns)
                self._taken_ns = self._clock()
            self._mail.notify_all()
            return frame

    def stop(self, timeout_s: float = 2.0) -> bool:
        """End the thread, which closes the camera; False when it did not end in time (stuck in the driver)."""
        self._stopping.set()
        with self._mail:
            self._mail.notify_all()
        if self._thread.is_alive():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._capture()
        except Exception as exc:
            self._count(last_error=str(exc) or type(exc).__name__)
            self._on_crash(exc)
        finally:
            self._camera.close()
            self._count(connected=False)
            with self._mail:
                self._ended = True
                self._mail.notify_all()

    def _capture(self) -> None:
        """Open, read until the camera is lost, wait a little longer each time, open again."""
        wait_s = self._cfg.reopen_min_s
        while not self._stopping.is_set():
            frames_before = self._counters.frames
            try:
                self._stream(self._open())
                return
            except CameraError as exc:
                self._lost(exc)
            self._camera.close()
            if self._counters.frames > frames_before:
                wait_s = self._cfg.reopen_min_s
            self._stopping.wait(wait_s)
            wait_s = min(2.0 * wait_s, max(self._cfg.reopen_max_s, self._cfg.reopen_min_s))

    def _open(self) -> CameraInfo:
        info = self._camera.open()
        first = self._info or info
        if (info.width_px, info.height_px) != (first.width_px, first.height_px):
            raise CameraError(
                f"camera {info.name}: came back with {info.width_px}x{info.height_px}, "
                f"expected {first.width_px}x{first.height_px} as before; plug the right camera in"
            )
        if info.camera_id and first.camera_id and info.camera_id != first.camera_id:
            raise CameraError(
                f"camera {info.name}: came back as {info.camera_id!r}, expected {first.camera_id!r}, which the "
                "calibration is for; plug the right camera in, or restart with its own calibration"
            )
        self._count(connected=True, reopens=self._counters.reopens + (self._info is not None))
        again = "again " if self._info is not None else ""
        self._info = info
        with self._mail:
            self.rate.opened(info.rate_hz if info.rate_hz > 0.0 else self._cfg.rate_hz)
        while len(self._pictures) > 1:  # a camera that starts again may show a test picture; a frozen one its last
            self._pictures.popleft()
        self._report("opened", f"{info.name} {again}gives {info.width_px}x{info.height_px} at {info.rate_hz:g} Hz")
        for note in info.notes:
            self._report("note", f"{info.name}: {note}")
        return info

    def _stream(self, info: CameraInfo) -> None:
        """Until the recording ends or stop(); raises CameraError on loss."""
        good_ns = self._clock()
        first = True
        bad_in_a_row = 0
        while not self._stopping.is_set():
            try:
                frame = self._camera.read()
                if frame is None:
                    return self._finish(info)
                self._check(frame, info)
            except BadFrameError as exc:
                bad_in_a_row += 1
                self._bad(exc, bad_in_a_row)
                if self._clock() - good_ns > self._cfg.read_timeout_s * 1e9:
                    raise CameraError(f"no usable frame for {self._cfg.read_timeout_s:g} s: {exc}") from exc
                continue
            if first and self._last is not None and frame.seq + self._seq_offset <= self._last.seq:
                self._seq_offset = self._last.seq + 1 - frame.seq
            first, bad_in_a_row, good_ns = False, 0, self._clock()
            self._deliver(replace(frame, seq=frame.seq + self._seq_offset), info.live)

    def _check(self, frame: Frame, info: CameraInfo) -> None:
        if frame.gray.shape != (info.height_px, info.width_px):
            raise BadFrameError(
                f"camera {info.name}: frame of {frame.gray.shape[1]}x{frame.gray.shape[0]}, "
                f"expected {info.width_px}x{info.height_px}"
            )
        if self._last is not None and frame.stamp_ns <= self._last.stamp_ns:
            self._count(bad_stamps=self._counters.bad_stamps + 1)
            raise BadFrameError(
                f"camera {info.name}: stamp {frame.stamp_ns} ns is not after the last one, {self._last.stamp_ns} ns"
            )
        if info.live and self._cfg.refuse_repeats:
            self._refuse_repeat(frame, info)

    def _refuse_repeat(self, frame: Frame, info: CameraInfo) -> None:
        """A frozen camera gives the last picture again, a driver that goes round old buffers one of some frames before.

        A uniform picture (lights out, glare) repeats itself without that.
        """
        picture = hash(frame.gray.tobytes())
        known, uniform = list(self._pictures), frame.gray.min() == frame.gray.max()
        self._pictures.append(picture)
        if uniform or picture not in known:
            return
        self._count(repeats=self._counters.repeats + 1)
        period = known[::-1].index(picture) + 1
        what = "the last one" if period == 1 else f"the one {period} frames before"
        why = "the camera is frozen" if period == 1 else "the camera repeats old buffers"
        raise BadFrameError(f"camera {info.name}: the picture is {what} again, byte for byte; {why}")

    def _deliver(self, frame: Frame, live: bool) -> None:
        self._last = frame
        with self._mail:
            if not live:
                self._mail.wait_for(lambda: self._frame is None or self._stopping.is_set())
                if self._frame is not None:
                    return
            replaced, dropped = self._frame is not None, self._is_due()
            self._frame = frame
            if live:
                self.rate.arrived(frame.stamp_ns)
            count = self._counters
            skipped = count.skipped + (replaced and not dropped)
            self._count(frames=count.frames + 1, drops=count.drops + dropped, skipped=skipped)
            self._mail.notify_all()
        while (news := self.rate.news()) is not None:
            self._report(news.kind, news.text)

    def _is_due(self) -> bool:
        """Whether there is a frame to take; under the lock."""
        return self._frame is not None and self.rate.is_due(self._frame.stamp_ns)

    def _finish(self, info: CameraInfo) -> None:
        with self._mail:
            self._finished = True
        self._report("finished", f"{info.name}: end after {self._counters.frames} frames")

    def _bad(self, exc: BadFrameError, in_a_row: int) -> None:
        self._count(bad_frames=self._counters.bad_frames + 1, last_error=str(exc))
        if in_a_row == 1:
            self._report("bad_frame", str(exc))

    def _lost(self, exc: CameraError) -> None:
        """Say it once, and again only when the reason changes while the camera is away."""
        news = self._counters.connected or str(exc) != self._counters.last_error
        self._count(losses=self._counters.losses + self._counters.connected, connected=False, last_error=str(exc))
        if news:
            self._report("lost", f"{exc}; trying again every {self._cfg.reopen_max_s:g} s")

    def _count(self, **changes: int | str | bool) -> None:
        # Only the capture thread writes, and a reader gets one whole snapshot or the next.
        self._counters = replace(self._counters, **changes)  # type: ignore[arg-type]

    def _report(self, kind: EventKind, text: str) -> None:
        self._on_event(CaptureEvent(kind, text))
