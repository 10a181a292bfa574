"""The daemon as a node of ROS 2: takes estimates from the estimator's thread, makes and sends messages in its own."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ceilvo.config import Ros2
from ceilvo.drivers.ports import Clock, Scene, Stamp
from ceilvo.drivers.ros2.cdr import Cdr
from ceilvo.drivers.ros2.conversion import Conversion
from ceilvo.drivers.ros2.endpoints import Endpoint, Endpoints
from ceilvo.drivers.ros2.intake import Intake
from ceilvo.drivers.ros2.speech import Speech
from ceilvo.drivers.ros2.transport import Transport
from ceilvo.types import Estimate, State

log = logging.getLogger(__name__)

_WAITING = 64
"""Estimates kept while the thread is busy; older ones are dropped and counted. Chosen: two seconds of them."""
_SCENE_PERIOD_NS = 10**9
"""Of landmarks and particles, while somebody subscribes."""
_JOIN_S = 0.5
"""That closing waits for a message in the making."""


@dataclass(frozen=True, slots=True)
class _Health:
    unix_ns: int
    state: State
    counters: Mapping[str, object]


Job = tuple[Estimate, Stamp, Callable[[], Scene]] | _Health


class Ros2Node:
    """A ports.Wire."""

    def __init__(
        self,
        config: Ros2,
        conversion: Conversion,
        cdr: Cdr,
        endpoints: Endpoints,
        transports: Sequence[Transport],
        intake: Intake,
        clock: Clock = time.monotonic_ns,
    ) -> None:
        self._config, self._conversion, self._cdr, self._clock = config, conversion, cdr, clock
        self._endpoints, self._transports, self._intake = endpoints, tuple(transports), intake
        self._changed = threading.Condition()
        self._jobs: deque[Job] = deque()
        self._stopping = False
        self._counts = {"samples": 0, "unsent": 0, "dropped": 0, "errors": 0}
        self._cpu_s = 0.0
        self._speech = Speech(config, conversion, endpoints)
        self._next_ns: dict[Endpoint, int] = {}
        self._thread = threading.Thread(target=self._run, name="ros2", daemon=True)

    def open(self) -> None:
        """
        Raises:
            BusError: a transport cannot be used.
        """
        for transport in self._transports:
            transport.open(self._intake)
        self._thread.start()

    def publish(self, estimate: Estimate, stamp: Stamp, scene: Callable[[], Scene]) -> None:
        """See ports.Wire."""
        self._add((estimate, stamp, scene))

    def health(self, unix_ns: int, state: State, counters: Mapping[str, object]) -> None:
        """See ports.Wire."""
        self._add(_Health(unix_ns, state, counters))

    def counters(self) -> dict[str, object]:
        with self._changed:
            return {**self._counts, "cpu_s": self._cpu_s, **self._intake.counters()}

    def close(self) -> None:
        """Idempotent, never raises; sends what waits."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread.ident is not None:
            self._thread.join(_JOIN_S)
        for transport in self._transports:
            transport.close()

    def _add(self, job: Job) -> None:
        with self._changed:
            if len(self._jobs) >= _WAITING:
                self._jobs.popleft()
                self._counts["dropped"] += 1
            self._jobs.append(job)
            self._changed.notify()

    # -- the thread

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._jobs and not self._stopping:
                    self._changed.wait()
                if not self._jobs:
                    return
                job = self._jobs.popleft()
            try:
                self._do(job)
            except Exception:  # a message that cannot be made must not end the estimate
                log.exception("a message for ROS 2 could not be made")
                self._count("errors")
            with self._changed:
                self._cpu_s = time.thread_time()

    def _do(self, job: Job) -> None:
        if isinstance(job, _Health):
            self._send(*self._speech.health(job.unix_ns, job.state, job.counters))
            return
        estimate, stamp, scene = job
        if not np.isfinite(np.concatenate([estimate.pose, estimate.odom, estimate.twist])).all():
            self._count("errors")
            return
        for said in self._speech.motion(estimate, stamp.unix_ns):
            self._send(*said)
        self._shown(estimate, stamp, scene)

    def _shown(self, estimate: Estimate, stamp: Stamp, scene: Callable[[], Scene]) -> None:
        """What costs work, only while somebody subscribes and no oftener than its period."""
        ends, now_ns = self._endpoints, self._clock()
        periods = dict.fromkeys((ends.landmarks, ends.particles), _SCENE_PERIOD_NS)
        periods |= dict.fromkeys((ends.image, ends.camera_info), round(1e9 / self._config.camera_rate_hz))
        due = {
            e for e in ends.shown if now_ns >= self._next_ns.get(e, 0) and any(t.wanted(e) for t in self._transports)
        }
        if not due:
            return
        self._next_ns |= {e: now_ns + periods[e] for e in due}
        make, seen = self._conversion, scene()
        picture_ns = stamp.unix_ns - stamp.ns + seen.picture_ns
        if ends.landmarks in due:
            self._send(ends.landmarks, make.landmarks(stamp.unix_ns, seen.landmarks, estimate.pose[:2]), stamp.unix_ns)
        if ends.particles in due:
            self._send(ends.particles, make.particles(stamp.unix_ns, seen.particles), stamp.unix_ns)
        if seen.jpeg is not None:
            if ends.image in due:
                self._send(ends.image, make.image(picture_ns, seen.jpeg()), picture_ns)
            if ends.camera_info in due:
                self._send(ends.camera_info, make.camera_info(picture_ns), picture_ns)

    def _send(self, endpoint: Endpoint, message: Any, unix_ns: int) -> None:
        payload = self._cdr.encode(message)
        sent = [transport.put(endpoint, payload, unix_ns) for transport in self._transports]
        self._count("samples" if any(sent) else "unsent")

    def _count(self, name: str) -> None:
        with self._changed:
            self._counts[name] += 1
