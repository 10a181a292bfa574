"""A daemon's configuration for one test, and an application that listens to it."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import numpy as np
import zenoh
from patience import PATIENCE_S

from ceilvo.config import Base, Config, Filter, Service, Zenoh
from ceilvo.drivers.bus.messages import Pose, decode_pose
from ceilvo.sim.world import World


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def config_of(world: World, base_port: str, zenoh_port: int, state_dir: Path | None = None) -> Config:
    x, y, theta = (float(v) for v in world.initial_pose)
    return Config(
        filter=Filter(initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))),
        base=Base(port=base_port, rate_hz=50.0, timeout_s=0.3),
        zenoh=Zenoh(listen=(f"tcp/127.0.0.1:{zenoh_port}",), multicast=False),
        service=Service(state_dir=str(state_dir or "")),
    )


class Subscriber:
    """Collects poses and events as any application would."""

    def __init__(self, port: int) -> None:
        conf = zenoh.Config()
        conf.insert_json5("scouting/multicast/enabled", "false")
        conf.insert_json5("listen/endpoints", "[]")
        conf.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
        conf.insert_json5("connect/timeout_ms", "10000")
        conf.insert_json5("connect/exit_on_failure", "false")
        self.poses: list[Pose] = []
        self.session = zenoh.open(conf)
        self._sub = self.session.declare_subscriber("ceilvo/robot1/pose", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        self.poses.append(decode_pose(sample.payload.to_bytes()))

    def ask(self, key: str, payload: str = "") -> dict[str, object]:
        for reply in self.session.get(f"ceilvo/robot1/{key}", payload=payload, timeout=PATIENCE_S):
            answer = reply.ok if reply.ok is not None else reply.err
            assert answer is not None
            parsed = json.loads(answer.payload.to_bytes())
            assert isinstance(parsed, dict)
            return parsed
        raise AssertionError(f"no reply from {key}")

    def close(self) -> None:
        self.session.close()
