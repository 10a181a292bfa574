"""Real Zenoh sessions over loopback TCP for tests of the bus: explicit ports, no multicast, no sleeping."""

from __future__ import annotations

import json
import queue
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import zenoh
from patience import PATIENCE_S, until

from ceilvo import config
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.drivers.bus import commands
from ceilvo.drivers.bus.requests import Handlers
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import Topic
from ceilvo.types import Landmarks


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def peer(*, listen: int | None = None, connect: int | None = None, mode: str = "peer") -> zenoh.Session:
    c = zenoh.Config()
    c.insert_json5("mode", json.dumps(mode))
    c.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{listen}"] if listen else []))
    c.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{connect}"] if connect else []))
    c.insert_json5("scouting/multicast/enabled", "false")
    c.insert_json5("open/return_conditions/connect_scouted", "false")
    return zenoh.open(c)


@dataclass
class Robot:
    """Handlers that remember; `refuse` makes every command fail with it."""

    calls: list[commands.Command] = field(default_factory=list)
    refuse: Exception | None = None

    def landmarks(self) -> Landmarks:
        return Landmarks(np.array([1]), np.array([[0.5, 1.5]]), np.eye(2)[None], np.array([4]), np.array([9]))

    def calibration(self) -> Calibration:
        camera = CameraModel("pinhole", 640, 480, 400.0, 400.0, 320.0, 240.0)
        m = projection_matrix(camera, mount_rotation(0.0), (0.25, 0.0), 2.0)
        return Calibration(camera, m, NoiseCurves((0.004,), (0.005,), 0.002, 0.2, 1.5))

    def command(self, request: commands.Command) -> Mapping[str, object]:
        if self.refuse is not None:
            raise self.refuse
        self.calls.append(request)
        return {"done": type(request).__name__}

    def handlers(self) -> Handlers:
        do = self.command
        return Handlers(self.landmarks, self.calibration, config.Config, do, do, do, do, pose=self.pose)

    def pose(self, asked: commands.PoseAt) -> bytes:
        return json.dumps({"predict_ms": asked.predict_ms}).encode()


class FakeClock:
    def __init__(self) -> None:
        self.ns = 0

    def __call__(self) -> int:
        return self.ns


@dataclass
class World:
    """A bus on a port, and what is needed to talk to it."""

    port: int
    robot: Robot
    clock: FakeClock
    bus: ZenohBus
    sessions: list[zenoh.Session] = field(default_factory=list)

    def other(self) -> zenoh.Session:
        self.sessions.append(peer(connect=self.port))
        return self.sessions[-1]

    def subscribe(self, session: zenoh.Session, key: str, topic: Topic | None = None) -> queue.Queue[zenoh.Sample]:
        """When `topic` is given, returns only after the bus knows of it."""
        inbox: queue.Queue[zenoh.Sample] = queue.Queue()
        session.declare_subscriber(key, inbox.put)
        if topic is not None:
            until(lambda: self.bus.wanted(topic), f"the bus knows of the subscriber of {topic.value}")
        return inbox


def bus_config(port: int, **changes: Any) -> config.Zenoh:
    return replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{port}",), multicast=False, **changes)


def get(session: zenoh.Session, key: str, payload: bytes | None = None) -> list[tuple[bool, dict[str, Any]]]:
    """Replies as (ok, message), after the queryable is known."""
    found: list[zenoh.Reply] = []

    def ask() -> bool:
        found[:] = list(session.get(key, payload=payload, timeout=PATIENCE_S))
        return bool(found)

    until(ask, f"an answer from {key}")
    return [(r.ok is not None, json.loads((r.ok or r.err).payload.to_bytes())) for r in found]
