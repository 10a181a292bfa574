"""A virtual bench: the simulated robot and its ceiling, for every step of commissioning, with the truth at hand."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.practice.virtual_board import board_shots
from ceilvo.calib.solve.mount.tracks import RUN, SPIN
from ceilvo.calib.targets.board import Board
from ceilvo.calib.targets.sources import Picture
from ceilvo.calibration import Calibration
from ceilvo.camera import CameraModel
from ceilvo.sim.ceiling.layout import CrossingType
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.world import World, WorldSpec

Array = NDArray[np.float64]

WHEEL_SCALE = 1.008
"""Of the true distance, that the wheels report."""
_FRAME_NS = 100_000_000
"""Between two pictures of the bench."""
_MIDDLE = (0.3, 0.7)
"""Of the room's side, where the robot is put."""
_WANDER_M, _WOBBLE_RAD, _RUN_M = 0.001, 0.01, 2.4
"""Of somebody who turns and pushes a robot by hand; chosen, measured on nobody."""
PAN_READOUT_S = 0.02
"""Of the camera in a pan; chosen: as webcams have it."""
_PAN_RAD, _PAN_S, _PAN_RATE_HZ = 0.6, 4.0, 30.0
"""Swing to either side, time to and fro: 0.94 rad/s at the most; chosen."""
_PAN_POSES = 17
"""While a picture is read, evenly."""
_TAPE_M, _PROTRACTOR_RAD = 0.001, 0.002
"""Sigma of poses measured by hand; chosen."""


_MARKS_M = np.array([[0.5, 0.3], [-0.5, 0.35], [-0.45, -0.4], [0.55, -0.3], [0.05, 0.6], [0.0, -0.05]])
"""Of discs to click for practice, from the point below the camera; chosen: all over the picture."""
_MARK_PX, _SHIFT = 6, 6
"""Radius of such a disc, and binary places of a pixel that it is drawn to."""


@dataclass(frozen=True)
class Place:
    """Where the robot stands, and how often it is looked at there."""

    pose: Array
    label: str = ""
    wheels: Array | None = None


class VirtualBench:
    """One rig under one ceiling; the seed chooses the noise and the ways driven, not the rig.

    Args:
        rig: the truth; None is the simulated robot of `ceilvod run --simulate`.
        world_seed: which ceiling.
    """

    def __init__(self, rig: Calibration | None = None, seed: int = 1, world_seed: int = 1) -> None:
        self.rig = rig or simulated_calibration()
        self.seed = seed
        self._world = World(WorldSpec(seed=world_seed), self.rig)

    @cached_property
    def world(self) -> World:
        return self._world

    def board(self, board: Board, count: int) -> Iterator[Picture]:
        return board_shots(self.rig.camera, board, count, self.seed)

    def places(self, count: int) -> Iterator[Picture]:
        """The robot stands here and there, turned every way."""
        rng = self._rng(1)
        room = self._world.spec.lap.room_m
        poses = [np.array([*rng.uniform(*_middle(room), 2), rng.uniform(-np.pi, np.pi)]) for _ in range(count)]
        return self._pictures([Place(p, f"place {i}") for i, p in enumerate(poses)], 1)

    def marks(self) -> tuple[NDArray[np.uint8], Array, Array]:
        """A picture (H, W) of discs on the ceiling, where they are in base (N, 3) and in the picture (N, 2), px."""
        rng = self._rng(9)
        middle = 0.5 * self._world.spec.lap.room_m
        gray = self._world.renderer.render(np.array([middle, middle, rng.uniform(-np.pi, np.pi)]), rng).copy()
        xyz = np.column_stack([self.rig.mount_xy_m + _MARKS_M + rng.uniform(-0.1, 0.1, _MARKS_M.shape), np.zeros(6)])
        eye = np.array([*self.rig.mount_xy_m, -self.rig.ceiling_height_m])
        uv = self.rig.camera.pixels((xyz - eye) @ self.rig.camera_from_base.T)
        for u, v in uv * 2**_SHIFT:
            for radius, level in ((_MARK_PX, 20), (_MARK_PX // 2, 240)):
                cv2.circle(gray, (round(u), round(v)), radius << _SHIFT, level, -1, cv2.LINE_AA, _SHIFT)
        return np.asarray(gray, np.uint8), np.round(xyz, 4), uv

    def spin_and_run(self, spin_frames: int = 150, run_frames: int = 60, turns: float = 4.0) -> Iterator[Picture]:
        """Round and round on the spot, wandering, then straight on with a hand's wobble."""
        rng = self._rng(2)
        room = self._world.spec.lap.room_m
        middle = np.array([0.5 * room, 0.5 * room])
        wander = _WANDER_M * np.column_stack([_smooth(rng, spin_frames, turns) for _ in range(2)])
        turn = np.linspace(0, 2 * np.pi * (turns + 0.05), spin_frames) + rng.uniform(-3, 3)
        spin = [np.array([*(middle + w), a]) for w, a in zip(wander, turn, strict=True)]
        heading = rng.uniform(-3, 3)
        pose = np.array([*(middle - 0.5 * _RUN_M * np.array([np.cos(heading), np.sin(heading)])), heading])
        run = [pose]
        wobble = _WOBBLE_RAD * _smooth(rng, run_frames)
        for i in range(1, run_frames):
            step = np.array([_RUN_M / run_frames, 0.0, 0.0])
            turned = wobble[i] - wobble[i - 1]
            pose = se2.compose(se2.compose(pose, np.array([0, 0, 0.5 * turned])), step)
            pose = se2.compose(pose, np.array([0, 0, 0.5 * turned]))
            run.append(pose)
        places = [Place(p, SPIN, w) for p, w in zip(spin, _wheels(spin), strict=True)]
        places += [Place(p, RUN, w) for p, w in zip(run, _wheels(run), strict=True)]
        return self._pictures(places, 3)

    def stations(self, count: int, looks: int) -> Iterator[Picture]:
        """Several places, several turns at each, several pictures of each."""
        rng = self._rng(4)
        room = self._world.spec.lap.room_m
        places = []
        for i in range(count):
            if i % 3 == 0:
                at = rng.uniform(*_middle(room), 2)
            pose = np.array([*at, rng.uniform(-np.pi, np.pi)])
            places += [Place(pose, f"station {i}")] * looks
        return self._pictures(places, 5)

    def circles(
        self, radii_m: tuple[float, ...] = (0.25, 0.6, 0.95), each: int = 9
    ) -> tuple[list[str], Iterator[Picture]]:
        """What a person would measure with a tape, on circles about a crossing of joints, and pictures of each pose."""
        rng = self._rng(6)
        room = self._world.spec.lap.room_m
        xy, crossing_type = self._world.ceiling.true_crossings()
        xy = xy[crossing_type == CrossingType.CROSS]
        mark = xy[np.argmin(np.hypot(*(xy - 0.5 * room).T))]
        poses, measured = [], []
        for r in radii_m:
            for k in range(each):
                a = 2.0 * np.pi * (k + rng.uniform(0, 0.5)) / each
                pose = np.array([r * np.cos(a), r * np.sin(a), rng.uniform(-np.pi, np.pi)])
                x, y, heading = pose + rng.normal(0, 1, 3) * [_TAPE_M, _TAPE_M, _PROTRACTOR_RAD]
                measured.append(f"{x:.4f} {y:.4f} {np.degrees(heading):.2f}")
                poses.append(Place(pose + np.array([*mark, 0.0]), "circle"))
        return measured, self._pictures(poses, 7)

    def pan(self, frames: int = 60, readout_s: float = PAN_READOUT_S) -> Iterator[Picture]:
        """To and fro on the spot, with a camera that reads row by row whatever the rig says."""
        rng = self._rng(8)
        camera = replace(self.rig.camera, readout_s=readout_s)
        late_s = camera.row_delays_s(np.linspace(0.0, camera.height_px - 1.0, _PAN_POSES))
        middle, start = 0.5 * self._world.spec.lap.room_m, rng.uniform(-np.pi, np.pi)
        for i in range(frames):
            t = i / _PAN_RATE_HZ + late_s
            turned = start + _PAN_RAD * np.sin(2.0 * np.pi * t / _PAN_S)
            pose = np.column_stack([np.full_like(t, middle), np.full_like(t, middle), turned])
            gray = self._world.renderer.render(pose[None], rng)
            yield Picture(f"pan {i}", 1 + round(1e9 * (1.0 + i / _PAN_RATE_HZ)), gray)

    def drive(self, frames: int, rate_hz: float = 10.0, lap_fraction: float = 1.0) -> Iterator[Picture]:
        """The lap of the simulated robot."""
        seconds = frames / rate_hz
        span_s = self._world.path.lap_m / self._world.spec.lap.speed_mps * lap_fraction + 2.0
        for i in range(frames):
            t = i / rate_hz * (span_s / seconds)
            gray = self._world.frame_at(t)
            yield Picture(f"drive {i}", 1 + round(1e9 * t), gray, wheels=self._world.wheel_odometry_at(t))

    def _pictures(self, places: list[Place], stream: int) -> Iterator[Picture]:
        rng = self._rng(100 + stream)
        for i, p in enumerate(places):
            gray = self._world.renderer.render(p.pose, rng, t_s=0.1 * i)
            yield Picture(f"{p.label or 'picture'} {i}", (i + 1) * _FRAME_NS, gray, wheels=p.wheels, label=p.label)

    def _rng(self, stream: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, 0xBE9C4, stream])


def _middle(room_m: float) -> tuple[float, float]:
    """From and to, of both coordinates, where the robot is put."""
    return _MIDDLE[0] * room_m, _MIDDLE[1] * room_m


def _smooth(rng: np.random.Generator, n: int, turns: float = 1.0) -> Array:
    """(n,) a wandering of about one unit, as slow as three times a turn and slower."""
    t, waves = np.linspace(0, 2 * np.pi, n), round(3 * turns)
    size = 0.6 * np.sqrt(3 / waves)
    return np.asarray(
        sum(rng.normal(0, size) * np.sin(k * t + rng.uniform(0, 6.28)) for k in range(1, waves + 1)), np.float64
    )


def _wheels(poses: list[Array]) -> list[Array]:
    """Cumulative odometry of wheels that report WHEEL_SCALE of the way, from the first pose."""
    out = [np.zeros(3)]
    for a, b in itertools.pairwise(poses):
        step = se2.between(a, b)
        out.append(se2.compose(out[-1], np.array([*(WHEEL_SCALE * step[:2]), step[2]])))
    return out


def random_rig(seed: int) -> Calibration:
    """A camera somebody might buy and bolt on somewhere, under some ceiling."""
    rng = np.random.default_rng([seed, 0x816])
    usual = simulated_camera()
    f = usual.fx_px * rng.uniform(0.92, 1.2)
    camera = CameraModel(
        "pinhole",
        usual.width_px,
        usual.height_px,
        f,
        f * rng.uniform(0.995, 1.005),
        usual.cx_px + rng.uniform(-8, 8),
        usual.cy_px + rng.uniform(-8, 8),
        (rng.uniform(-0.2, 0.02), rng.uniform(-0.02, 0.05), *rng.uniform(-1e-3, 1e-3, 2), rng.uniform(-0.01, 0.005)),
    )
    return simulated_calibration(
        camera,
        mount_xy_m=(rng.uniform(-0.15, 0.15), rng.uniform(-0.15, 0.15)),
        yaw_rad=rng.uniform(-np.pi, np.pi),
        roll_rad=np.radians(rng.uniform(-2, 2)),
        pitch_rad=np.radians(rng.uniform(-2, 2)),
        ceiling_height_m=rng.uniform(1.9, 2.8),
    )
