"""Estimates, maps and calibrations as ROS 2's messages (REP-103, REP-105): SI units, never NaN, frames by config."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.config import Ros2
from ceilvo.drivers.ros2.cdr import Cdr
from ceilvo.types import Estimate, Landmarks, State

Array = NDArray[np.float64]

UNKNOWN = 1e6
"""Variance of what nobody observes, m^2 and rad^2: robot_localization's and nav2's custom."""
_LEAST_VARIANCE = 1e-12
"""Filters that fuse it invert it; chosen: (1 um)^2 and (1 urad)^2 are below anything measured."""
_XY_YAW = np.array([0, 1, 5])
"""Of x y z rx ry rz."""
UNUSABLE = (State.INIT, State.LOST, State.RELOCALISING, State.STOPPED)
"""States whose pose must not be used: it has no known variance then, and map -> odom is not sent."""
_OK, _WARN, _ERROR, _STALE = 0, 1, 2, 3
_LEVEL = {
    State.TRACKING: _OK,
    State.DEGRADED: _WARN,
    State.DEAD_RECKONING: _WARN,
    State.INIT: _ERROR,
    State.LOST: _ERROR,
    State.RELOCALISING: _ERROR,
    State.STOPPED: _STALE,
}
MOST_MARKERS = 5000
"""The nearest ones; chosen: they cost 15 ms a message."""
MOST_PARTICLES = 2000
_SPHERE_LIST = 7
_MARKER_M = 0.05
"""Chosen: to be seen, and smaller than a tile's joint is long."""


class Conversion:
    """Makes messages. Times are nanoseconds since 1970."""

    def __init__(self, config: Ros2, robot: str, calibration: Calibration, cdr: Cdr) -> None:
        self._config, self._robot, self._calibration, self._cdr = config, robot, calibration, cdr

    # -- transforms

    def map_from_odom(self, e: Estimate, unix_ns: int) -> Any:
        """Dated ahead by the tolerance, so that a look-up at the newest odometry finds it."""
        ahead_ns = round(1e9 * self._config.transform_tolerance_s)
        c = self._config
        return self._transform(unix_ns + ahead_ns, c.map_frame, c.odom_frame, se2.compose(e.pose, se2.inverse(e.odom)))

    def odom_from_base(self, e: Estimate, unix_ns: int, base_frame: str) -> Any:
        return self._transform(unix_ns, self._config.odom_frame, base_frame, e.odom)

    def base_from_camera(self, unix_ns: int) -> Any:
        """Its height above base is not calibrated: 0."""
        turn = self._calibration.camera_from_base.T
        x, y = (float(v) for v in self._calibration.mount_xy_m)
        c = self._config
        return self._stamped(unix_ns, c.base_frame, c.camera_frame, (x, y, 0.0), quaternion(turn))

    def tf(self, *transforms: Any) -> Any:
        return self._cdr.make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    # -- pose and odometry

    def pose(self, e: Estimate, unix_ns: int) -> Any:
        cov = np.full((3, 3), np.nan) if e.state in UNUSABLE else e.cov
        return self._cdr.make(
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            header=self._header(unix_ns, self._config.map_frame),
            pose=self._with_covariance(e.pose, cov),
        )

    def odometry(self, e: Estimate, unix_ns: int, cov: Array, twist_cov: Array) -> Any:
        """cov: (3, 3) of odom in its own frame; twist_cov: (3, 3) of the twist in base."""
        make = self._cdr.make
        vx, vy, omega = (float(v) for v in e.twist)
        zero = self._vector(0.0, 0.0, 0.0)
        twist = make(
            "geometry_msgs/msg/Twist",
            linear=self._vector(vx, vy, 0.0),
            angular=self._vector(0.0, 0.0, omega) if omega else zero,
        )
        return make(
            "nav_msgs/msg/Odometry",
            header=self._header(unix_ns, self._config.odom_frame),
            child_frame_id=self._config.base_frame,
            pose=self._with_covariance(e.odom, cov),
            twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=covariance6(twist_cov)),
        )

    # -- health

    def diagnostics(self, unix_ns: int, state: State, last: Estimate | None, counters: Mapping[str, object]) -> Any:
        make = self._cdr.make
        shown: dict[str, object] = {"state": state.name}
        if last is not None:
            shown |= {"seq": last.seq, "quality": last.quality, "reason": last.reason, "nis": last.health.nis}
            shown |= {"crossings": last.crossings, "landmarks": last.landmarks}
            shown |= {"map_id": last.floor} if last.floor else {}
        shown |= {name: counters[name] for name in _SHOWN if name in counters}
        for stage, times in dict(_mapping(counters.get("latency_ms"))).items():
            shown |= {f"latency_{stage}_{k}_ms": v for k, v in _mapping(times).items()}
        values = [make("diagnostic_msgs/msg/KeyValue", key=k, value=_text(v)) for k, v in shown.items()]
        status = make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=_LEVEL[state],
            name="ceilvo: localisation",
            message=f"{state.name}: {last.reason}" if last is not None and last.reason else state.name,
            hardware_id=self._robot,
            values=values,
        )
        return make("diagnostic_msgs/msg/DiagnosticArray", header=self._header(unix_ns, ""), status=[status])

    # -- what is looked at

    def landmarks(self, unix_ns: int, landmarks: Landmarks, near_xy_m: Array) -> Any:
        """One list of spheres on the ceiling, coloured by kind."""
        xy, kind = landmarks.xy_map_m, landmarks.crossing_type
        if len(xy) > MOST_MARKERS:
            nearest = np.argpartition(np.hypot(*(xy - near_xy_m).T), MOST_MARKERS)[:MOST_MARKERS]
            xy, kind = xy[nearest], kind[nearest]
        make, height = self._cdr.make, self._calibration.ceiling_height_m
        colours = {k: self._colour(int(k)) for k in set(kind.tolist())}
        marker = make(
            "visualization_msgs/msg/Marker",
            header=self._header(unix_ns, self._config.map_frame),
            ns="landmarks",
            id=0,
            type=_SPHERE_LIST,
            action=0,
            pose=self._pose(np.zeros(3)),
            scale=self._vector(_MARKER_M, _MARKER_M, _MARKER_M),
            color=self._colour(0),
            lifetime=make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
            frame_locked=False,
            points=[make("geometry_msgs/msg/Point", x=x, y=y, z=height) for x, y in xy.tolist()],
            colors=[colours[k] for k in kind.tolist()],
            texture_resource="",
            texture=make(
                "sensor_msgs/msg/CompressedImage",
                header=self._header(0, ""),
                format="",
                data=np.zeros(0, np.uint8),
            ),
            uv_coordinates=[],
            text="",
            mesh_resource="",
            mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
            mesh_use_embedded_materials=False,
        )
        return make("visualization_msgs/msg/MarkerArray", markers=[marker])

    def particles(self, unix_ns: int, poses: Array) -> Any:
        step = max(1, -(-len(poses) // MOST_PARTICLES))
        return self._cdr.make(
            "geometry_msgs/msg/PoseArray",
            header=self._header(unix_ns, self._config.map_frame),
            poses=[self._pose(p) for p in poses[::step] if np.isfinite(p).all()],
        )

    def image(self, unix_ns: int, data: bytes, kind: str = "jpeg") -> Any:
        return self._cdr.make(
            "sensor_msgs/msg/CompressedImage",
            header=self._header(unix_ns, self._config.camera_frame),
            format=kind,
            data=np.frombuffer(data, np.uint8),
        )

    def camera_info(self, unix_ns: int) -> Any:
        camera, make = self._calibration.camera, self._cdr.make
        model, distortion = distortion_of(camera.kind, camera.distortion)
        whole = make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return make(
            "sensor_msgs/msg/CameraInfo",
            header=self._header(unix_ns, self._config.camera_frame),
            height=camera.height_px,
            width=camera.width_px,
            distortion_model=model,
            d=np.array(distortion, np.float64),
            k=camera.matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack([camera.matrix, np.zeros(3)]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=whole,
        )

    # -- parts

    def _header(self, unix_ns: int, frame: str) -> Any:
        stamp = self._cdr.make("builtin_interfaces/msg/Time", sec=unix_ns // 10**9, nanosec=unix_ns % 10**9)
        return self._cdr.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._cdr.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _pose(self, pose: Array) -> Any:
        x, y, theta = (float(v) for v in pose)
        return self._cdr.make(
            "geometry_msgs/msg/Pose",
            position=self._cdr.make("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
            orientation=self._quaternion((0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2))),
        )

    def _quaternion(self, xyzw: tuple[float, float, float, float]) -> Any:
        x, y, z, w = xyzw
        return self._cdr.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _with_covariance(self, pose: Array, cov: Array) -> Any:
        return self._cdr.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(pose), covariance=covariance6(cov)
        )

    def _transform(self, unix_ns: int, parent: str, child: str, parent_from_child: Array) -> Any:
        x, y, theta = (float(v) for v in parent_from_child)
        turn = (0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2))
        return self._stamped(unix_ns, parent, child, (x, y, 0.0), turn)

    def _stamped(
        self,
        unix_ns: int,
        parent: str,
        child: str,
        xyz_m: tuple[float, float, float],
        xyzw: tuple[float, float, float, float],
    ) -> Any:
        make = self._cdr.make
        return make(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(unix_ns, parent),
            child_frame_id=child,
            transform=make(
                "geometry_msgs/msg/Transform", translation=self._vector(*xyz_m), rotation=self._quaternion(xyzw)
            ),
        )

    def _colour(self, kind: int) -> Any:
        """A hue a kind of landmark, the same ones every time."""
        turn = 2.0 * math.pi * ((0.618 * kind) % 1.0)
        r, g, b = (0.5 + 0.5 * math.cos(turn - shift) for shift in (0.0, 2.1, 4.2))
        return self._cdr.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0)


_SHOWN = ("fps", "frames", "drops", "late_frames", "estimate_age_s", "camera_connected", "calibration_stale", "base_up")
"""Of the health message's counters."""


def covariance6(cov: Array) -> Array:
    """(36,) of x y z rx ry rz from (3, 3) of x y theta; what is not known is UNKNOWN, never 0 or NaN."""
    out = np.zeros((6, 6))
    np.fill_diagonal(out, UNKNOWN)
    if np.isfinite(cov).all():
        out[np.ix_(_XY_YAW, _XY_YAW)] = cov
        at = (_XY_YAW, _XY_YAW)
        out[at] = np.clip(out[at], _LEAST_VARIANCE, None)
    return out.ravel()


def quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """(x, y, z, w) of a rotation matrix (3, 3), w >= 0: an eigenvector (Bar-Itzhack 2000)."""
    r = rotation
    k = np.array(
        [
            [r[0, 0] - r[1, 1] - r[2, 2], 0, 0, 0],
            [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], 0, 0],
            [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], 0],
            [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
        ]
    )
    q = np.linalg.eigh(k)[1][:, -1]  # of the lower triangle
    q = q if q[3] >= 0.0 else -q
    return float(q[0]), float(q[1]), float(q[2]), float(q[3])


def distortion_of(kind: str, distortion: tuple[float, ...]) -> tuple[str, tuple[float, ...]]:
    """ROS's name of a lens model and its coefficients, as many as that model has."""
    if kind == "fisheye":
        return "equidistant", (*distortion, 0.0, 0.0, 0.0, 0.0)[:4]
    if len(distortion) > 5:
        return "rational_polynomial", (*distortion, 0.0, 0.0, 0.0)[:8]
    return "plumb_bob", (*distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]


def _mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}" if math.isfinite(value) else ""
    return "" if value is None else str(value)
