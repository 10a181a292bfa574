"""The protocols that the process wires together. Fakes and real devices pass the same contract tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.types import Estimate, Frame, Landmarks, State


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """What an opened camera delivers.

    Attributes:
        name: for messages.
        camera_id: what identifies the camera, for the check against the calibration; "" = unknown.
        live: False for a recording, which ends and whose frames wait until they are read.
        notes: one line each on what was accepted though it is not as asked or not as it should be.
    """

    name: str
    camera_id: str
    width_px: int
    height_px: int
    rate_hz: float
    live: bool
    notes: tuple[str, ...] = ()


class Camera(Protocol):
    """A source of frames.

    open() may be called again after close() or after a CameraError; seq goes on counting across reopenings of a live
    camera, a recording starts again. read() blocks for a bounded time (the camera's read timeout). Stamps increase
    strictly from frame to frame. Used by one thread at a time.
    """

    def open(self) -> CameraInfo:
        """Raises CameraError when the device is absent, busy or cannot do what the configuration asks, and
        FileFormatError when a recording cannot be used (trying again does not help)."""

    def read(self) -> Frame | None:
        """The next frame in order, None at the end of a recording (a live camera never ends).

        Raises CameraError on loss or timeout: close and open again. Raises BadFrameError when this frame cannot be
        used but the camera is there: read again. Raises FileFormatError when a recording is damaged.
        """

    def close(self) -> None:
        """Idempotent, never raises."""


class Base(Protocol):
    """A base controller. Every failure is a BaseLinkError that names the port and what to do."""

    @property
    def is_open(self) -> bool:
        """False before open(), after close(), and after the port was lost: then open() again."""

    def open(self) -> None:
        """Raises BaseLinkError when the port is absent, busy or not permitted."""

    def exchange(self, telegram: PoseTelegram) -> BaseStatus:
        """Write the pose, read the status; bounded time.

        Raises BaseLinkError when the base does not answer as it should. The port stays open unless it was lost.
        """

    def close(self) -> None:
        """Idempotent, never raises."""


class Topic(str, Enum):
    """What is published; the value is the last part of the key."""

    POSE = "pose"
    ODOM = "odom"
    HEALTH = "health"
    EVENT = "event"
    LANDMARKS = "landmarks"
    PARTICLES = "particles"
    IMAGE = "image"


ON_DEMAND = (Topic.LANDMARKS, Topic.PARTICLES, Topic.IMAGE)
"""Made only while somebody subscribes."""


class Publisher(Protocol):
    """The bus: what the daemon says, and the requests it answers. Every method may be called from any thread."""

    def open(self) -> None:
        """Bounded time; a router or peer that is absent is waited for in the background.

        Raises BusError when the bus cannot be used as configured.
        """

    def put(self, topic: Topic, payload: bytes) -> None:
        """Send now, without waiting for an answer; what cannot be sent is dropped and counted. Never raises."""

    def wanted(self, topic: Topic) -> bool:
        """Whether somebody subscribes; costs microseconds."""

    def offer(self, topic: Topic, make: Callable[[], bytes]) -> None:
        """For messages that cost work: `make` runs later, in the bus's own thread, and only if somebody subscribes and
        the topic's period has passed. It must only read what does not change any more. Newest offer wins."""

    def counters(self) -> Mapping[str, int]:
        """Snapshot, the same names every time."""

    def close(self) -> None:
        """Bounded time, idempotent, never raises."""


@dataclass(frozen=True, slots=True)
class Scene:
    """What is looked at rather than driven by; nothing in it changes any more.

    Attributes:
        particles: (N, 3) map_from_base, drawn from the belief.
        picture_ns: when the picture was taken, CLOCK_MONOTONIC.
        jpeg: makes it, with what was found in it; None before the first.
    """

    landmarks: Landmarks
    particles: NDArray[np.float64]
    picture_ns: int = 0
    jpeg: Callable[[], bytes] | None = None


class Wire(Protocol):
    """Somebody else's way to read the daemon, beside the bus. Every method may be called from any thread."""

    def open(self) -> None:
        """Raises BusError when it cannot be used as configured."""

    def publish(self, estimate: Estimate, stamp: Stamp, scene: Callable[[], Scene]) -> None:
        """Takes microseconds and never raises; `scene` is called later, in the wire's own thread, if at all."""

    def health(self, unix_ns: int, state: State, counters: Mapping[str, object]) -> None:
        """Once a second or so, and at the end."""

    def counters(self) -> Mapping[str, object]:
        """Snapshot, the same names every time."""

    def close(self) -> None:
        """Bounded time, idempotent, never raises."""


@dataclass(frozen=True, slots=True)
class Stamp:
    """One instant on both clocks: CLOCK_MONOTONIC of the robot's computer, and nanoseconds since 1970."""

    ns: int
    unix_ns: int


class Clock(Protocol):
    """CLOCK_MONOTONIC in nanoseconds; a fake in tests."""

    def __call__(self) -> int: ...
