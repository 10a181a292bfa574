"""One room with its ceiling, one robot in it, one camera on the robot: everything that a simulated device asks."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ceilvo.calibration import Calibration
from ceilvo.sim.ceiling.ceiling import Ceiling
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapPath, LapSpec, TiltProfile, TiltSpec, WheelOdometry, WheelSpec
from ceilvo.sim.renderer import Renderer, RenderSpec
from ceilvo.sim.rig import simulated_calibration
from ceilvo.sim.surroundings.surroundings import SurroundingsSpec, make_surfaces

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

_TILT_ROOM_RAD = 0.05
"""By which the robot may rock, for how far it sees."""
_EDGE_POINTS = 33
"""Along each edge of the picture, to find how far it sees."""
_ROW_POSES = 17
"""Of a rolling shutter, over all rows; chosen: between two, 3 deg of turning bend a ray by less than a microradian."""
_MARGIN_MOST_M = 4.0
"""Of ceiling beyond the walls: a fisheye would see without end, and texels cost memory."""


@dataclass(frozen=True)
class WorldSpec:
    """What can be chosen about a world; ceiling.room_m follows lap.room_m, and the margin grows with the lens."""

    seed: int = 1
    lap: LapSpec = field(default_factory=LapSpec)
    ceiling: CeilingSpec = field(default_factory=CeilingSpec)
    render: RenderSpec = field(default_factory=RenderSpec)
    wheels: WheelSpec = field(default_factory=WheelSpec)
    tilt: TiltSpec = field(default_factory=TiltSpec)
    surroundings: SurroundingsSpec = field(default_factory=SurroundingsSpec)


GYRO_BIAS_RADPS = 0.005
"""Of the simulated base's gyro: .3 deg/s; chosen: an ordinary chip."""


class World:
    """A deterministic function of time. frame_at() is for one thread at a time, the rest for any.

    World time is seconds since start(); before it the robot stands at its initial pose.
    """

    def __init__(self, spec: WorldSpec | None = None, calibration: Calibration | None = None) -> None:
        self.spec = spec or WorldSpec()
        self.calibration = calibration or simulated_calibration()
        self.path = LapPath(self.spec.lap)
        self.wheels = WheelOdometry(self.path, self.spec.wheels, self.spec.seed)
        self.tilt = TiltProfile(self.path, self.spec.tilt, self.spec.seed)
        self._t0_ns: int | None = None

    def start(self, t0_ns: int) -> int:
        """Set the stamp of world time 0, CLOCK_MONOTONIC; only the first call does. Returns what holds."""
        if self._t0_ns is None:
            self._t0_ns = int(t0_ns)
        return self._t0_ns

    def seconds(self, stamp_ns: int) -> float:
        """World time of a stamp; 0 while the world has not started."""
        return 0.0 if self._t0_ns is None else (stamp_ns - self._t0_ns) / 1e9

    @property
    def initial_pose(self) -> Array:
        """(3,) map_from_base at world time 0."""
        return self.path.pose_at(0.0)

    def truth_at(self, t_s: ArrayLike) -> Array:
        """map_from_base, (..., 3) for t_s of shape (...)."""
        return self.path.pose_at(t_s)

    def twist_at(self, t_s: ArrayLike) -> Array:
        """True velocity in base [m/s, m/s, rad/s], (..., 3)."""
        return self.path.twist_at(t_s)

    def tilt_at(self, t_s: ArrayLike) -> Array:
        """True rotation of the body about base x and y [rad], (..., 2)."""
        return self.tilt.at(t_s)

    def wheel_odometry_at(self, t_s: float) -> Array:
        """(3,) cumulative odom_from_base as the wheels report it."""
        return self.wheels.at(t_s)

    def gyro_at(self, t_s: float) -> float:
        """Integral of the yaw rate that a gyro of the base measures, rad; its bias is in it."""
        return float(self.path.turned_at(t_s)) + GYRO_BIAS_RADPS * t_s

    def frame_at(self, t_s: float) -> Gray:
        """(H, W) uint8: the exposure that starts at t_s, that of the middle row. The same time gives the same bytes."""
        render, camera = self.spec.render, self.calibration.camera
        k = render.sub_poses if render.exposure_s > 0 else 1
        t = t_s + render.exposure_s * (np.arange(k) + 0.5) / k
        if camera.readout_s:
            t = t[:, None] + camera.row_delays_s(np.linspace(0.0, camera.height_px - 1.0, _ROW_POSES))
        rng = np.random.default_rng([self.spec.seed, round(max(t_s, 0.0) * 1e9)])
        return self.renderer.render(self.truth_at(t), rng, self.tilt_at(t), t_s)

    @cached_property
    def ceiling(self) -> Ceiling:
        """Drawn on first use."""
        need = _reach_m(self.calibration) - self.spec.lap.inset_m
        margin = max(self.spec.ceiling.margin_m, min(need, _MARGIN_MOST_M))
        spec = replace(self.spec.ceiling, room_m=self.spec.lap.room_m, margin_m=margin)
        return Ceiling(spec, self.spec.seed)

    @cached_property
    def renderer(self) -> Renderer:
        spec = self.spec
        height = self.calibration.ceiling_height_m
        surfaces = make_surfaces(spec.surroundings, spec.lap.room_m, height, spec.seed)
        return Renderer(self.calibration, self.ceiling, spec.render, spec.seed, surfaces)


def _reach_m(calibration: Calibration) -> float:
    """How far from the robot's centre the camera sees the ceiling when the robot rocks."""
    cam = calibration.camera
    x, y = np.linspace(0, cam.width_px - 1, _EDGE_POINTS), np.linspace(0, cam.height_px - 1, _EDGE_POINTS)
    edge = [np.column_stack([x, np.full(_EDGE_POINTS, v)]) for v in (0.0, cam.height_px - 1.0)]
    edge += [np.column_stack([np.full(_EDGE_POINTS, u), y]) for u in (0.0, cam.width_px - 1.0)]
    rays = cam.rays(np.concatenate(edge)) @ calibration.camera_from_base
    angle = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]).max() + _TILT_ROOM_RAD
    if angle >= 0.5 * np.pi:
        return float("inf")
    return float(calibration.ceiling_height_m * np.tan(angle) + np.hypot(*calibration.mount_xy_m))
