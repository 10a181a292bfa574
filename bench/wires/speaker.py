"""Only the daemon's wires, fed with estimates of 30 Hz: `python -m ceilvo.bench.wires.speaker PORT MODE SECONDS`.

Prints one line of JSON: the processor seconds that it took from its first estimate to its last, Zenoh's and DDS's own
threads with them.
"""

from __future__ import annotations

import argparse
import json
import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.config import Config, Ros2, Zenoh
from ceilvo.daemon.app.wires import wires_of
from ceilvo.drivers.bus import messages
from ceilvo.drivers.bus.requests import Handlers
from ceilvo.drivers.ports import Scene, Stamp, Topic
from ceilvo.types import Displacement, Estimate, FilterHealth, Landmarks, Motion, Pose, State, Twist

RATE_HZ, LANDMARKS, PARTICLES = 30.0, 300, 100
WIRES = {"json": ("json",), "all": ("json", "rmw_zenoh", "ros2dds")}
_WARM_UP = 60
"""Estimates before the clock starts."""


def config_of(mode: str, port: int) -> Config:
    """All: both wires on Zenoh, free_fleet's key, DDS."""
    extra = mode != "json"
    zenoh = Zenoh(connect=(f"tcp/127.0.0.1:{port}",), multicast=False, wire=WIRES[mode], allow_same_name=True)
    return Config(zenoh=zenoh, ros2=Ros2(odom_to_base=extra, fleet_tf=extra, dds=extra, domain_id=os.getpid() % 100))


def calibration() -> Calibration:
    camera = CameraModel("pinhole", 640, 480, 410.0, 410.0, 320.0, 240.0)
    projection = projection_matrix(camera, mount_rotation(0.0), (0.05, 0.0), 2.2)
    return Calibration(camera, projection, NoiseCurves((0.004,), (0.005,), 0.002, 0.2, 1.5))


def estimate(seq: int, stamp_ns: int) -> Estimate:
    turn = 0.01 * seq
    pose = Pose(np.array([3.0 + np.cos(turn), 3.0 + np.sin(turn), np.pi * np.sin(0.1 * turn)]))
    motion = Motion(Displacement(np.array([0.01, 0.0, 0.01])), np.diag([1e-8, 1e-8, 1e-9]), 24, 0.001)
    health = FilterHealth(PARTICLES, 70.0, 12, 0.1, 1.1, 18)
    cov, twist = np.diag([1e-5, 1e-5, 1e-6]), Twist(np.array([0.3, 0.0, 0.1]))
    return Estimate(
        seq, stamp_ns, pose, cov, Pose(pose - 0.5), twist, State.TRACKING, 0.97, "", motion, health, 31, LANDMARKS
    )


def scene() -> Scene:
    rng = np.random.default_rng(1)
    one, cov = np.ones(LANDMARKS, np.int64), np.tile(1e-4 * np.eye(2), (LANDMARKS, 1, 1))
    landmarks = Landmarks(np.arange(LANDMARKS), rng.uniform(0, 20, (LANDMARKS, 2)), cov, 4 * one, one)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (480, 640, 3), np.uint8), (15, 15), 5)

    def jpeg() -> bytes:
        return np.asarray(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])[1], np.uint8).tobytes()

    return Scene(landmarks, rng.uniform(0, 20, (PARTICLES, 3)), time.monotonic_ns(), jpeg)


def speak(mode: str, port: int, seconds: float, on_ready: Callable[[], None]) -> dict[str, object]:
    """Publish as daemon.app.outputs does; the figures."""
    config, shown = config_of(mode, port), scene()

    def nothing(*_: object) -> dict[str, object]:
        return {}

    handlers = Handlers(lambda: shown.landmarks, calibration, lambda: config, nothing, nothing, nothing, nothing)
    wires = wires_of(config, calibration(), handlers)
    for wire in wires.others:
        wire.open()
    assert wires.bus is not None
    wires.bus.open()
    on_ready()
    period_s, begun_s, cpu_s = 1.0 / RATE_HZ, time.monotonic(), 0.0
    pause, count = threading.Event(), int(seconds * RATE_HZ) + _WARM_UP
    for seq in range(count):
        if seq == _WARM_UP:
            cpu_s = time.process_time()
        pause.wait(max(0.0, begun_s + seq * period_s - time.monotonic()))
        now_ns = time.monotonic_ns()
        e, stamp = estimate(seq, now_ns), Stamp(now_ns, time.time_ns())
        for wire in wires.others:
            wire.publish(e, stamp, lambda at=now_ns: replace(shown, picture_ns=at))  # type: ignore[misc]
        wires.bus.put(Topic.POSE, messages.encode_pose("robot1", e, stamp.unix_ns, now_ns))
        wires.bus.put(Topic.ODOM, messages.encode_odom("robot1", e, stamp.unix_ns))
        wires.bus.offer(Topic.LANDMARKS, lambda s=stamp: messages.encode_landmarks("robot1", s, shown.landmarks))  # type: ignore[misc]
        if seq % int(RATE_HZ) == 0:
            for wire in wires.others:
                wire.health(stamp.unix_ns, e.state, {"fps": 30.0, "drops": 0, "latency_ms": {"total": {"median": 1.0}}})
    cpu_s = time.process_time() - cpu_s
    counters = [dict(wire.counters()) for wire in wires.others]
    samples = wires.bus.counters()["samples"]
    wires.bus.close()
    for wire in wires.others:
        wire.close()
    return {"cpu_s": cpu_s, "seconds": (count - _WARM_UP) * period_s, "samples": samples, "others": counters}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, epilog="example: python -m ceilvo.bench.wires.speaker 7447 all 10"
    )
    parser.add_argument("port", type=int, help="of the router on this computer")
    parser.add_argument("mode", choices=list(WIRES), help="which wires")
    parser.add_argument("seconds", type=float, help="how long")
    options = parser.parse_args()

    def ready() -> None:
        print("ready", flush=True)

    print(json.dumps(speak(options.mode, options.port, options.seconds, ready)), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()
