"""`ceilvod run --simulate`: a rendered ceiling, a robot that drives laps, and a Modbus base on a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.app.process import Plan
from ceilvo.daemon.app.screen import Screen
from ceilvo.sim.base import SimBase
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.motion import TiltSpec
from ceilvo.sim.world import World, WorldSpec


@contextmanager
def simulation(
    config: Config,
    seed: int,
    seconds: float | None,
    summary_file: Path,
    calibration: Calibration | None = None,
    tilt_rad: float = 0.0,
) -> Iterator[Plan]:
    """The plan of a simulated robot; its base lives as long as the context.

    Args:
        calibration: what the daemon believes; None = the truth.
        tilt_rad: the body rocks by up to this while it drives.
    """
    world = World(WorldSpec(seed=seed, tilt=TiltSpec(tilt_rad)))
    _ = world.renderer  # drawn now: it takes a second of processor time, in which the base would not be heard
    base = SimBase(
        baud=config.base.baud,
        parity=config.base.parity,
        unit_id=config.base.unit_id,
        odometry=lambda t_s: tuple(world.wheel_odometry_at(world.seconds(round(1e9 * t_s)))),
        version=config.base.protocol,
        gyro=lambda t_s: world.gyro_at(world.seconds(round(1e9 * t_s))),
    )
    x, y, theta = (float(v) for v in world.initial_pose)
    lens, room_m = world.calibration.camera, world.spec.lap.room_m
    with base:
        config = replace(
            config,
            camera=replace(config.camera, width_px=lens.width_px, height_px=lens.height_px),
            base=replace(config.base, port=base.port),
            filter=replace(
                config.filter,
                initial_pose_x_m=x,
                initial_pose_y_m=y,
                initial_pose_theta_deg=float(np.degrees(theta)),
            ),
        )
        yield Plan(
            config,
            calibration or world.calibration,
            SimCamera(world, config.camera.rate_hz),
            truth=lambda stamp_ns: world.truth_at(world.seconds(stamp_ns)),
            room_m=(0.0, 0.0, room_m, room_m),
            seconds=seconds,
            summary_file=summary_file,
            screen=Screen,
        )
