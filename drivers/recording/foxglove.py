"""Messages that Foxglove shows without extensions, in Protocol Buffers by Foxglove's own schemas."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.drivers.pictures import decoded
from ceilvo.errors import FileFormatError

Array = NDArray[np.float64]

MOST_SPHERES = 2000
"""Landmarks in a scene, the nearest ones; chosen: 10 ms of work."""
MOST_ARROWS = 200
"""Particles in a scene."""
_SPHERE_M, _ARROW_M, _LINE_M = 0.05, 0.15, 0.02
"""Chosen: to be seen in a room."""
_LANDMARK, _PARTICLE, _PATH = (0.95, 0.7, 0.1, 1.0), (0.3, 0.6, 1.0, 0.6), (0.2, 0.9, 0.4, 1.0)
"""Red, green, blue, opacity."""
_LINE_STRIP = 0
"""LinePrimitive.LINE_STRIP."""


def raw_image(unix_ns: int, gray: NDArray[np.uint8], frame_id: str) -> bytes:
    """A foxglove.RawImage of a grey picture (H, W), bit for bit."""
    h, w = gray.shape
    m = _kind("RawImage")(width=w, height=h, encoding="mono8", step=w, data=gray.tobytes(), frame_id=frame_id)
    return _stamped(m, unix_ns)


def read_raw_image(data: bytes) -> NDArray[np.uint8]:
    """The pixels of raw_image().

    Raises:
        FileFormatError: it is anything else.
    """
    m = _parsed(_kind("RawImage"), data)
    try:
        if m.encoding != "mono8" or m.step != m.width or not m.width or not m.height:
            raise ValueError("not a mono8 picture without gaps")
        return np.frombuffer(m.data, np.uint8).reshape(m.height, m.width)
    except ValueError as e:
        raise FileFormatError(f"picture of {len(data)} bytes: {e}; the recording is damaged") from e


def compressed_image(unix_ns: int, data: bytes, image_format: str, frame_id: str) -> bytes:
    """A foxglove.CompressedImage; image_format is "jpeg" or "png"."""
    return _stamped(_kind("CompressedImage")(data=data, format=image_format, frame_id=frame_id), unix_ns)


def compressed_bytes(data: bytes) -> tuple[bytes, str]:
    """What compressed_image() was given: an encoded picture, and "jpeg" or "png".

    Raises:
        FileFormatError: it is anything else.
    """
    m = _parsed(_kind("CompressedImage"), data)
    return bytes(m.data), str(m.format)


def read_compressed_image(data: bytes) -> NDArray[np.uint8]:
    """The grey pixels of compressed_image().

    Raises:
        FileFormatError: it is anything else.
    """
    gray = decoded(_parsed(_kind("CompressedImage"), data).data)
    if gray is None:
        raise FileFormatError(f"picture of {len(data)} bytes cannot be decoded; the recording is damaged")
    return gray


def pose_in_frame(unix_ns: int, frame_id: str, pose: Array) -> bytes:
    """A foxglove.PoseInFrame of (3,) [m, m, rad]: a place on the floor and a turn about z."""
    m = _kind("PoseInFrame")(frame_id=frame_id)
    _set_pose(m.pose, pose)
    return _stamped(m, unix_ns)


def log_line(unix_ns: int, level: int, name: str, message: str) -> bytes:
    """A foxglove.Log; level is Python's (20 = info)."""
    number: Any = min(max(level // 10, 1), 5)  # as LogLevel counts
    return _stamped(_kind("Log")(level=number, name=name, message=message), unix_ns)


def frame_transforms(unix_ns: int, *transforms: tuple[str, str, Array]) -> bytes:
    """A foxglove.FrameTransforms of (parent, child, parent_from_child): (3,) planar, or (7,) x y z qx qy qz qw."""
    m = _kind("FrameTransforms")()
    for parent, child, value in transforms:
        t = m.transforms.add(parent_frame_id=parent, child_frame_id=child)
        _set_time(t.timestamp, unix_ns)
        where = value.tolist() if len(value) == 7 else [*value[:2].tolist(), 0.0, 0.0, 0.0, *_half_angle(value[2])]
        t.translation.x, t.translation.y, t.translation.z = where[:3]
        t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w = where[3:]
    return bytes(m.SerializeToString())


def camera_calibration(
    unix_ns: int, frame_id: str, size_px: tuple[int, int], model: str, distortion: Iterable[float], matrix: Array
) -> bytes:
    """A foxglove.CameraCalibration; size is width and height, matrix (3, 3), model ROS's name of the lens model."""
    m = _kind("CameraCalibration")(frame_id=frame_id, width=size_px[0], height=size_px[1], distortion_model=model)
    m.D.extend(distortion)
    m.K.extend(matrix.ravel().tolist())
    m.R.extend(np.eye(3).ravel().tolist())
    m.P.extend(np.column_stack([matrix, np.zeros(3)]).ravel().tolist())
    return _stamped(m, unix_ns)


def scene_update(
    unix_ns: int, frame_id: str, landmarks_m: Array, particles: Array, path_m: Array, pose: Array, ceiling_m: float
) -> bytes:
    """A foxglove.SceneUpdate: landmarks (L, 2) on the ceiling, particles (N, 3) and the path (P, 2) on the floor."""
    m = _kind("SceneUpdate")()
    near = landmarks_m
    if len(near) > MOST_SPHERES:
        near = near[np.argpartition(np.hypot(*(near - pose[:2]).T), MOST_SPHERES)[:MOST_SPHERES]]
    entity = _entity(m, "landmarks", unix_ns, frame_id)
    for x, y in near.tolist():
        sphere = entity.spheres.add()
        sphere.pose.position.x, sphere.pose.position.y, sphere.pose.position.z = x, y, ceiling_m
        sphere.pose.orientation.w = 1.0
        sphere.size.x = sphere.size.y = sphere.size.z = _SPHERE_M
        _set_colour(sphere.color, _LANDMARK)
    entity = _entity(m, "particles", unix_ns, frame_id)
    step = max(1, -(-len(particles) // MOST_ARROWS))
    for particle in particles[::step]:
        if np.isfinite(particle).all():
            arrow = entity.arrows.add(shaft_length=0.7 * _ARROW_M, shaft_diameter=_LINE_M, head_length=0.3 * _ARROW_M)
            arrow.head_diameter = 2.0 * _LINE_M
            _set_pose(arrow.pose, particle)
            _set_colour(arrow.color, _PARTICLE)
    entity = _entity(m, "path", unix_ns, frame_id)
    if len(path_m):
        line = entity.lines.add(type=_LINE_STRIP, thickness=_LINE_M)
        line.pose.orientation.w = 1.0
        _set_colour(line.color, _PATH)
        for x, y in path_m.tolist():
            line.points.add(x=x, y=y, z=0.0)
    return bytes(m.SerializeToString())


def read_scene(data: bytes) -> tuple[Array, Array]:
    """Landmarks (L, 2) and particles (N, 3) of scene_update(), as many as it has.

    Raises:
        FileFormatError: it is anything else.
    """
    entities = {e.id: e for e in _parsed(_kind("SceneUpdate"), data).entities}
    spheres = entities["landmarks"].spheres if "landmarks" in entities else ()
    arrows = entities["particles"].arrows if "particles" in entities else ()
    xy = [(s.pose.position.x, s.pose.position.y) for s in spheres]
    poses = [(a.pose.position.x, a.pose.position.y, _angle(a.pose.orientation)) for a in arrows]
    return np.array(xy, np.float64).reshape(-1, 2), np.array(poses, np.float64).reshape(-1, 3)


# -- schemas


def schema(name: str) -> bytes:
    """The FileDescriptorSet of a message, "foxglove.Log" as an example, and of all that it needs."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files = FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        if file.name not in seen:
            seen.add(file.name)
            for needed in file.dependencies:
                add(needed)
            file.CopyToProto(files.file.add())

    add(_kind(name.removeprefix("foxglove.")).DESCRIPTOR.file)
    return bytes(files.SerializeToString())


# -- parts


@cache
def _kind(name: str) -> Any:
    """A message of Foxglove. Protocol Buffers are slow to load: the daemon's first pose does not wait for them."""
    return getattr(import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


def _parsed(message: Any, data: bytes) -> Any:
    from google.protobuf.message import DecodeError

    try:
        return message.FromString(data)
    except DecodeError as e:
        raise FileFormatError(f"message of {len(data)} bytes is not ours; the recording is damaged") from e


def _stamped(message: Any, unix_ns: int) -> bytes:
    _set_time(message.timestamp, unix_ns)
    return bytes(message.SerializeToString())


def _set_time(timestamp: Any, unix_ns: int) -> None:
    timestamp.seconds, timestamp.nanos = divmod(unix_ns, 10**9)


def _set_pose(to: Any, pose: Array) -> None:
    to.position.x, to.position.y = float(pose[0]), float(pose[1])
    to.orientation.z, to.orientation.w = _half_angle(pose[2])


def _half_angle(theta_rad: float) -> tuple[float, float]:
    """qz and qw of a turn about z."""
    return float(np.sin(theta_rad / 2.0)), float(np.cos(theta_rad / 2.0))


def _angle(q: Any) -> float:
    """Of a turn about z."""
    return float(2.0 * np.arctan2(q.z, q.w))


def _set_colour(to: Any, rgba: tuple[float, float, float, float]) -> None:
    to.r, to.g, to.b, to.a = rgba


def _entity(scene: Any, name: str, unix_ns: int, frame_id: str) -> Any:
    """It replaces the one of this name."""
    entity = scene.entities.add(id=name, frame_id=frame_id)
    _set_time(entity.timestamp, unix_ns)
    return entity
