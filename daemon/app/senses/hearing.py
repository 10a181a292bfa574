"""Where senses beside camera and wheels are listened to, as the configuration says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import zenoh

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.app.senses.beacons import BeaconSenses
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.bus.imu_topic import NAME, ImuTopic
from ceilvo.drivers.ports import Base, Clock
from ceilvo.senses.beacons import Beacons
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.senses.prediction import predicted
from ceilvo.types import Estimate, Frame, WheelMotion


class Hearing:
    """All senses of one robot but the camera. Asked from the estimator's thread.

    Attributes:
        base: None where there is none.
    """

    def __init__(
        self,
        config: Config,
        port: Callable[[], Base],
        clock: Clock,
        on_crash: Callable[[BaseException], None],
        calibration: Calibration | None = None,
    ) -> None:
        """
        Args:
            port: of the base, asked for where there is one.
            calibration: without it no lamps are looked for.
        """
        self._clock = clock
        self.base: BaseLink | None = None
        if config.base.enabled:
            self.base = BaseLink(config.base, port(), clock, on_crash, config.senses.any)
        self._wheels = self.base if config.base.use_wheels else None
        self._noise = float(np.radians(config.senses.gyro_noise_dps)) ** 2
        self._base = self.base if config.senses.gyro == "base" else None
        self._topic = ImuTopic(clock, self._noise) if config.senses.gyro == "topic" else None
        self._stem = f"{config.zenoh.prefix}/{config.robot.name}"
        self._beacons = BeaconSenses(config, self._stem, clock, on_crash, calibration)

    def wheels(self, stamp0_ns: int, stamp1_ns: int) -> WheelMotion | None:
        """What the base's wheels did between two frames."""
        return None if self._wheels is None else self._wheels.wheels.between(stamp0_ns, stamp1_ns)

    def between(self, stamp0_ns: int, stamp1_ns: int) -> Heard:
        """What they say of the time between two frames."""
        heard = NOTHING
        if self._base is not None:
            heard = Heard(self._base.wheels.turn_between(stamp0_ns, stamp1_ns, self._noise))
        elif self._topic is not None:
            heard = Heard(self._topic.turn_between(stamp0_ns, stamp1_ns))
        ranges = self._beacons.ranges(stamp1_ns)
        return replace(heard, ranges=ranges) if ranges else heard

    @property
    def known(self) -> Beacons:
        """Anchors, marks and lamps of the file."""
        return self._beacons.known

    def shown(self, frame: Frame, sure: bool, heard: Heard) -> Heard:
        """What is heard, with the marks and lamps in a frame; sure: whether the place is."""
        return self._beacons.shown(frame, sure, heard)

    def start(self) -> None:
        """Talk to the base and to a radio module."""
        if self.base is not None:
            self.base.start()
        self._beacons.start()

    def stop(self) -> None:
        """But for the base, which is told the end first."""
        self._beacons.stop()

    def ahead(self, estimate: Estimate, ahead_ms: float) -> tuple[Estimate, float]:
        """The estimate with the pose of so long after now, and by how many ms it was moved on; from any thread."""
        to_ns = self._clock() + round(1e6 * ahead_ms)
        wheels = None if self._wheels is None else self._wheels.wheels.aside(estimate.stamp_ns, to_ns)
        pose, cov, ahead_s = predicted(estimate, to_ns, wheels)
        return replace(estimate, pose=pose, cov=cov), 1e3 * ahead_s

    @property
    def keys(self) -> tuple[str, ...]:
        """Of the robot's own keys, those where others speak."""
        own = () if self._topic is None else (f"{self._stem}/{NAME}",)
        return own + self._beacons.keys

    def counters(self) -> Mapping[str, object]:
        """What was taken and refused."""
        own = {} if self._topic is None else {"imu_samples": self._topic.taken, "imu_refused": self._topic.refused}
        return own | self._beacons.counters()

    def declare(self, session: zenoh.Session) -> None:
        """Listen on Zenoh."""
        if self._topic is not None:
            self._topic.declare(session, self.keys[0])
        self._beacons.declare(session)
