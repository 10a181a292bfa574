"""A simulated drive of some seconds as the daemon records it, with all that stumbles on the way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ceilvo.config import Base, Config, Filter, Recorder, Service, Zenoh
from ceilvo.daemon.app.process import Daemon, Plan
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.ports import CameraInfo
from ceilvo.errors import CameraError
from ceilvo.sim.base import SimBase
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Frame

SEED, FRAMES = 7, 120


class Flickering(SimCamera):
    """Lost after every fortieth frame, so that there are silences, events and unknown quantities."""

    read_so_far = 0

    def read(self) -> Frame | None:
        self.read_so_far += 1
        if self.read_so_far % 40 == 0:
            raise CameraError("camera: unplugged")
        return super().read()

    def open(self) -> CameraInfo:
        return super().open()


def record_drive(folder: Path, lossless: bool) -> Path:
    """A drive with a base that answers, a camera that stumbles, a start again and a pose from outside."""
    world = World(WorldSpec(seed=SEED))
    x, y, theta = (float(v) for v in world.initial_pose)
    start = Filter(initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta)))
    file = folder / "drive.mcap" if lossless else None
    with SimBase(baud=115200) as base:
        config = Config(
            filter=start,
            base=Base(port=base.port, rate_hz=50.0, timeout_s=0.3),
            zenoh=Zenoh(enabled=False, health_period_s=0.1),
            service=Service(state_dir=str(folder)),
            recorder=Recorder(reserve_bytes=0),
        )
        daemon = Daemon(Plan(config, world.calibration, Flickering(world, 30.0), record=file), Notifier({}))
        publish, seen = daemon._outputs.publish, [0]

        def watch(estimate: Any) -> None:
            publish(estimate)
            seen[0] += 1
            if seen[0] == FRAMES // 2:
                daemon._estimator.reset(keep_map=False)
            if seen[0] == 2 * FRAMES // 3:
                daemon._estimator.set_pose(estimate.pose, np.full(3, 0.1), "said by a test")
            if seen[0] >= FRAMES:
                daemon.stop()

        daemon._outputs.publish = watch  # type: ignore[method-assign]
        daemon.run()
    return file or max((folder / "recorder").rglob("*.mcap"), key=lambda f: f.stat().st_size)
