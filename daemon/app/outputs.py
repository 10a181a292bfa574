"""What every estimate goes to: the base, Zenoh, the log, the recorder."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.app.requests import Ahead, as_it_is
from ceilvo.daemon.replay.pictures import Pictures
from ceilvo.daemon.replay.recording import RecordingTap
from ceilvo.daemon.vision.finder.crossing_finder import View
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.bus import messages
from ceilvo.drivers.ports import ON_DEMAND, Publisher, Scene, Stamp, Topic, Wire
from ceilvo.types import Array, Estimate, Landmarks, State

log = logging.getLogger("ceilvo")

_EVENTS = 20
"""Latest events kept; chosen: the screen shows 3 of them."""
_PREDICTIONS = 30
"""Kept: a picture is made in another thread, a few frames later."""


MapOf = Callable[[str], tuple[str, int | None]]


def no_map(floor: str) -> tuple[str, int | None]:
    """Where no maps are kept."""
    return floor, None


class Outputs:
    """Thread-safe for events and health; estimates come from one thread."""

    def __init__(
        self,
        robot: str,
        calibration: Calibration,
        estimator: Estimator,
        base: BaseLink | None,
        bus: Publisher | None,
        clock: Callable[[], int],
        recording: RecordingTap | None = None,
        wires: Sequence[Wire] = (),
        map_of: MapOf = no_map,
        ahead: Ahead = as_it_is,
        predict_ms: float | None = None,
    ) -> None:
        """map_of: name and version of the map of a floor, see Store.map_of; ahead: see handlers(); predict_ms: as
        zenoh.predict_ms."""
        self._robot, self._pictures, self._estimator = robot, Pictures(calibration), estimator
        self._base, self._bus, self._clock, self._recording = base, bus, clock, recording
        self._wires, self._map_of = tuple(wires), map_of
        self._ahead, self._predict_ms = ahead, predict_ms
        self._reported: State | None = None
        self._predicted: dict[int, Array] = {}
        self._pose: Array | None = None
        self.events: deque[str] = deque(maxlen=_EVENTS)

    def publish(self, estimate: Estimate) -> None:
        """To the base, then to Zenoh, the other wires and the recorder; none of them blocks."""
        if self._base is not None:
            self._base.submit(estimate)
        self._predict(estimate)
        now_ns = self._clock()
        stamp = Stamp(estimate.stamp_ns, time.time_ns() - (now_ns - estimate.stamp_ns))
        for wire in self._wires:
            wire.publish(estimate, stamp, self._scene)
        if self._bus is not None:
            map_ = self._map_of(estimate.floor)
            then, ms = (estimate, None) if self._predict_ms is None else self._ahead(estimate, self._predict_ms)
            self._bus.put(Topic.POSE, messages.encode_pose(self._robot, then, stamp.unix_ns, now_ns, *map_, ms))
            self._bus.put(Topic.ODOM, messages.encode_odom(self._robot, estimate, stamp.unix_ns))
            self._offer(self._bus, estimate.seq, stamp)
        if self._recording is not None:
            self._recording.published(estimate)
        for name, reason in self._estimator.noticed():
            self.event(name, reason, logging.WARNING)
        if estimate.state is not self._reported:
            before = "start" if self._reported is None else self._reported.name
            self._reported = estimate.state
            level = logging.INFO if estimate.state is State.TRACKING else logging.WARNING
            self.event("state", f"{before} -> {estimate.state.name}: {estimate.reason}", level)

    def _offer(self, bus: Publisher, seq: int, stamp: Stamp) -> None:
        """What costs work to make, only while somebody subscribes."""
        if not any(bus.wanted(topic) for topic in ON_DEMAND):
            return
        shown, robot = self._estimator.display(), self._robot
        bus.offer(Topic.LANDMARKS, lambda: messages.encode_landmarks(robot, stamp, shown.landmarks))
        bus.offer(Topic.PARTICLES, lambda: messages.encode_particles(robot, seq, stamp, shown.particles, shown.weights))
        view = shown.view
        if view is not None:
            bus.offer(Topic.IMAGE, lambda: self._jpeg(view, shown.landmarks))

    def _predict(self, estimate: Estimate) -> None:
        """Where the robot was thought to be before this frame was taken into account, for the latest frames."""
        if self._pose is not None:
            self._predicted[estimate.stamp_ns] = se2.compose(self._pose, estimate.motion.prev_from_curr)
            while len(self._predicted) > _PREDICTIONS:
                del self._predicted[next(iter(self._predicted))]
        self._pose = np.asarray(estimate.pose, np.float64)

    def _scene(self) -> Scene:
        """Called by other wires, in their threads."""
        shown = self._estimator.display()
        view = shown.view
        if view is None:
            return Scene(shown.landmarks, shown.particles)
        return Scene(shown.landmarks, shown.particles, view.frame.stamp_ns, lambda: self._jpeg(view, shown.landmarks))

    def _jpeg(self, view: View, landmarks: Landmarks) -> bytes:
        return self._pictures.jpeg(view, landmarks, self._predicted.get(view.frame.stamp_ns))

    def close(self) -> None:
        """No pictures any more."""
        self._pictures.close()

    def event(self, name: str, text: str, level: int = logging.INFO) -> None:
        """Something that happened once: in the log, on the screen and on Zenoh."""
        log.log(level, "%s", text)
        self.events.append(text)
        if self._recording is not None:
            self._recording.event(level, name, text)
        if self._bus is not None:
            stamp = Stamp(self._clock(), time.time_ns())
            severity = logging.getLevelName(level).lower()
            self._bus.put(Topic.EVENT, messages.encode_event(self._robot, stamp, name, severity, text))

    def health(self, state: State, uptime_s: float, counters: Mapping[str, object]) -> None:
        stamp = Stamp(self._clock(), time.time_ns())
        payload = messages.encode_health(self._robot, stamp, uptime_s, state, counters)
        for wire in self._wires:
            wire.health(stamp.unix_ns, state, counters)
        if self._bus is not None:
            self._bus.put(Topic.HEALTH, payload)
        if self._recording is not None:
            self._recording.health(payload, counters)
