"""What makes a recording a 3D scene: frames, the camera's lens, landmarks, particles and the way so far."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.drivers.recording import foxglove, mcap_file
from ceilvo.drivers.recording.mcap_file import Message
from ceilvo.drivers.ros2.conversion import distortion_of, quaternion
from ceilvo.types import Array, Estimate

Look = Callable[[], tuple[Array, Array]]
"""Landmarks (L, 2) and particles (N, 3) in map, as they are now; nothing in them changes any more."""

MAP_FRAME, ODOM_FRAME, BASE_FRAME, CAMERA_FRAME = "map", "odom", "base_link", "camera"

_PERIOD_NS = 10**9
"""Of everything but poses: every file of the flight recorder has it, and it costs little; chosen."""
_PATH_POINTS, _PATH_STEP_M = 1000, 0.05
"""Of the way so far: 50 m of it; chosen."""


class Scenery:
    """Messages beside each estimate. Not thread-safe; what is slow is done when the recorder writes."""

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._mount = mount(calibration)
        self._path: deque[Array] = deque(maxlen=_PATH_POINTS)
        self._next_ns = 0

    def messages(self, estimate: Estimate, look: Look) -> list[Message]:
        """Of an estimate that is finite; `look` is called once a second."""
        e = estimate
        if not self._path or float(np.hypot(*(e.pose - self._path[-1])[:2])) > _PATH_STEP_M:
            self._path.append(e.pose)
        out = [
            Message(mcap_file.POSE, e.stamp_ns, lambda ns: foxglove.pose_in_frame(ns, MAP_FRAME, e.pose)),
            Message(mcap_file.TRANSFORMS, e.stamp_ns, lambda ns: transforms(ns, e.pose, e.odom)),
        ]
        if e.stamp_ns < self._next_ns:
            return out
        self._next_ns = e.stamp_ns + _PERIOD_NS
        landmarks, particles = look()
        path, height_m = np.array(self._path)[:, :2], self._calibration.ceiling_height_m

        def scene(ns: int) -> bytes:
            return foxglove.scene_update(ns, MAP_FRAME, landmarks, particles, path, e.pose, height_m)

        fixed = (BASE_FRAME, CAMERA_FRAME, self._mount)
        out.append(Message(mcap_file.TRANSFORMS, e.stamp_ns, lambda ns: foxglove.frame_transforms(ns, fixed)))
        out.append(Message(mcap_file.CAMERA, e.stamp_ns, lambda ns: lens(ns, self._calibration)))
        out.append(Message(mcap_file.SCENE, e.stamp_ns, scene))
        return out


def transforms(unix_ns: int, pose: Array, odom: Array) -> bytes:
    """map -> odom -> base of (3,) map_from_base and odom_from_base."""
    map_from_odom = se2.compose(pose, se2.inverse(odom))
    chain = ((MAP_FRAME, ODOM_FRAME, map_from_odom), (ODOM_FRAME, BASE_FRAME, odom))
    return foxglove.frame_transforms(unix_ns, *chain)


def mount(calibration: Calibration) -> Array:
    """(7,) base_from_camera, x y z qx qy qz qw; its height above base is not calibrated: 0."""
    x, y = calibration.mount_xy_m
    return np.array([x, y, 0.0, *quaternion(calibration.camera_from_base.T)])


def lens(unix_ns: int, calibration: Calibration) -> bytes:
    """A foxglove.CameraCalibration."""
    c = calibration.camera
    model, distortion = distortion_of(c.kind, c.distortion)
    return foxglove.camera_calibration(unix_ns, CAMERA_FRAME, (c.width_px, c.height_px), model, distortion, c.matrix)
