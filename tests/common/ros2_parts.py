"""A ROS 2 node without a daemon: an estimate by hand, transports that keep all, requests that are remembered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
from zenoh_world import Robot

from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.config import Ros2
from ceilvo.drivers.bus.requests import Requests
from ceilvo.drivers.ports import Scene
from ceilvo.drivers.ros2.cdr import Cdr
from ceilvo.drivers.ros2.conversion import Conversion
from ceilvo.drivers.ros2.endpoints import Endpoint, Endpoints, endpoints
from ceilvo.drivers.ros2.intake import Intake
from ceilvo.drivers.ros2.node import Ros2Node
from ceilvo.drivers.ros2.transport import Transport
from ceilvo.types import Estimate, FilterHealth, Landmarks, Motion, State

UNIX_NS = 1_750_000_000_123_456_789


def estimate(seq: int = 42, state: State = State.TRACKING, **changes: object) -> Estimate:
    made = Estimate(
        seq, 4_980_000_000 + 33_000_000 * (seq - 42), np.array([1.25, -0.5, 0.75]),
        np.array([[4e-4, 1e-5, 0.0], [1e-5, 9e-4, 2e-6], [0.0, 2e-6, 2.5e-5]]), np.array([0.5, 0.25, -0.5]),
        np.array([0.3, 0.0, -0.125]), state, 0.97, "few lamps",
        Motion(np.array([0.01, 0.0, -0.004]), np.diag([1e-6, 2e-6, 3e-6]), 24, 0.0012),
        FilterHealth(100, 71.5, 12, 0.1, 1.1, 18), 31, 57, MappingProxyType({"total": 14.0}),
    )  # fmt: skip
    return replace(made, **changes)  # type: ignore[arg-type]


def calibration() -> Calibration:
    camera = CameraModel("pinhole", 640, 480, 400.0, 402.0, 320.0, 240.0, (0.1, -0.05, 0.001, 0.002, 0.01))
    m = projection_matrix(camera, mount_rotation(np.pi / 2), (0.25, -0.1), 2.0)
    return Calibration(camera, m, NoiseCurves((0.004,), (0.005,), 0.002, 0.2, 1.5))


def scene() -> Scene:
    xy = np.array([[0.5, 1.5], [2.0, -1.0]])
    cov, one = np.tile(np.eye(2), (2, 1, 1)), np.ones(2, np.int64)
    landmarks = Landmarks(np.arange(2), xy, cov, np.array([4, 10]), one)
    return Scene(landmarks, np.array([[1.0, 2.0, 0.5], [np.nan, 0.0, 0.0]]), 4_970_000_000, lambda: b"\xff\xd8jpeg")


@dataclass
class Kept:
    """A transport.Transport that remembers; `subscribed` is who is wanted."""

    subscribed: set[Endpoint] = field(default_factory=set)
    sent: list[tuple[Endpoint, bytes, int]] = field(default_factory=list)

    def open(self, intake: Intake) -> None: ...

    def put(self, endpoint: Endpoint, payload: bytes, unix_ns: int) -> bool:
        self.sent.append((endpoint, payload, unix_ns))
        return True

    def wanted(self, endpoint: Endpoint) -> bool:
        return endpoint in self.subscribed

    def close(self) -> None: ...


@dataclass
class Parts:
    config: Ros2
    cdr: Cdr
    ends: Endpoints
    conversion: Conversion
    robot: Robot
    intake: Intake
    node: Ros2Node

    def decoded(self, kept: Kept, endpoint: Endpoint) -> list[object]:
        return [self.cdr.decode(p, e.message) for e, p, _ in kept.sent if e == endpoint]


def parts(*transports: Transport, clock: Callable[[], int] = lambda: 0, **changes: object) -> Parts:
    config = replace(Ros2(), **changes)  # type: ignore[arg-type]
    cdr, robot = Cdr(config.distribution), Robot()
    ends = endpoints(config, "robot1")
    conversion = Conversion(config, "robot1", calibration(), cdr)
    intake = Intake(config, cdr, ends, Requests("robot1", robot.handlers()).answer)
    node = Ros2Node(config, conversion, cdr, ends, transports, intake, clock)
    return Parts(config, cdr, ends, conversion, robot, intake, node)
