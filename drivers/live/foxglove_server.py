"""A running robot in Foxglove: its messages on Zenoh, served over Foxglove's websocket (foxglove-sdk)."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from ceilvo.config import Zenoh
from ceilvo.drivers.bus import messages
from ceilvo.drivers.live.feed import ALIVE, Feed
from ceilvo.drivers.ports import Topic
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.drivers.recording import foxglove, mcap_file
from ceilvo.drivers.recording.scene import BASE_FRAME, CAMERA_FRAME, MAP_FRAME, transforms
from ceilvo.errors import BusError, ConfigError, one_line
from ceilvo.types import Array

log = logging.getLogger(__name__)

TOPICS = (Topic.POSE, Topic.ODOM, Topic.HEALTH, Topic.EVENT, Topic.LANDMARKS, Topic.PARTICLES, Topic.IMAGE)
_PATH_POINTS, _PATH_STEP_M = 1000, 0.05
_SCENE_S = 0.5
"""Between two scenes; chosen."""
_ASK_AGAIN_S = 5.0
"""For the calibration, while nobody answers."""
_LEVELS = {"info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


class View:
    """Turns the robot's messages into Foxglove's. `log_to` takes a channel, bytes and nanoseconds since 1970."""

    def __init__(self, log_to: Callable[[mcap_file.Channel, bytes, int], None]) -> None:
        self._log_to = log_to
        self._pose: Array | None = None
        self._path: deque[Array] = deque(maxlen=_PATH_POINTS)
        self._landmarks, self._particles = np.empty((0, 2)), np.empty((0, 3))
        self._stamp_ns = 0
        self._ceiling_m = 0.0
        self._mount: Array | None = None
        self._lens: Callable[[int], bytes] | None = None

    @property
    def has_calibration(self) -> bool:
        return self._lens is not None

    def take(self, topic: str, payload: bytes) -> None:
        """One message of the robot.

        Raises:
            BusError: it is none of ceilvo's.
        """
        if topic == Topic.IMAGE.value:
            now_ns = self._stamp_ns or time.time_ns()
            self._log_to(mcap_file.PICTURES, foxglove.compressed_image(now_ns, payload, "jpeg", CAMERA_FRAME), now_ns)
            return
        try:
            self._json(topic, messages.decode(payload, topic), payload)
        except (KeyError, TypeError, ValueError) as e:
            raise BusError(f"{topic} message: {type(e).__name__} {one_line(str(e))}") from e

    def calibration(self, payload: bytes) -> None:
        """The reply of `/calibration`.

        Raises:
            BusError: it is none of ceilvo's.
        """
        f = messages.decode(payload, "calibration")
        self._ceiling_m, self._mount, self._lens = calibration_of(f)

    def scene(self) -> None:
        """What is looked at, as it is known now."""
        if self._pose is None:
            return
        at = self._stamp_ns
        path = np.array(self._path).reshape(-1, 3)[:, :2]
        made = foxglove.scene_update(at, MAP_FRAME, self._landmarks, self._particles, path, self._pose, self._ceiling_m)
        self._log_to(mcap_file.SCENE, made, at)
        if self._mount is not None and self._lens is not None:
            fixed = foxglove.frame_transforms(at, (BASE_FRAME, CAMERA_FRAME, self._mount))
            self._log_to(mcap_file.TRANSFORMS, fixed, at)
            self._log_to(mcap_file.CAMERA, self._lens(at), at)

    def _json(self, topic: str, f: dict[str, Any], payload: bytes) -> None:
        at = int(f["stamp_unix_ns"])
        if topic == Topic.POSE.value:
            pose = np.array([f["x_m"], f["y_m"], f["theta_rad"]], np.float64)
            if not np.isfinite(pose).all():
                return
            self._pose, self._stamp_ns = pose, at
            if not self._path or float(np.hypot(*(pose - self._path[-1])[:2])) > _PATH_STEP_M:
                self._path.append(pose)
            self._log_to(mcap_file.POSE, foxglove.pose_in_frame(at, MAP_FRAME, pose), at)
            self._log_to(_POSE_JSON, payload, at)
        elif topic == Topic.ODOM.value and self._pose is not None and at == self._stamp_ns:
            odom = np.array([f["x_m"], f["y_m"], f["theta_rad"]], np.float64)
            self._log_to(mcap_file.TRANSFORMS, transforms(at, self._pose, odom), at)
        elif topic == Topic.EVENT.value:
            level = _LEVELS.get(str(f["severity"]), logging.INFO)
            self._log_to(mcap_file.EVENT, foxglove.log_line(at, level, str(f["event"]), str(f["text"])), at)
        elif topic == Topic.HEALTH.value:
            self._log_to(mcap_file.HEALTH, payload, at)
        elif topic == Topic.LANDMARKS.value:
            self._landmarks = np.column_stack([f["x_m"], f["y_m"]]).astype(np.float64)
        elif topic == Topic.PARTICLES.value:
            self._particles = np.column_stack([f["x_m"], f["y_m"], f["theta_rad"]]).astype(np.float64)


_POSE_JSON = mcap_file.Channel("/pose/figures", "ceilvo.pose.1", varied=True)
"""State, quality and the rest, to plot."""
CHANNELS = (
    *(mcap_file.POSE, _POSE_JSON, mcap_file.TRANSFORMS, mcap_file.EVENT, mcap_file.HEALTH, mcap_file.PICTURES),
    *(mcap_file.SCENE, mcap_file.CAMERA),
)
"""All that a View writes to."""


def calibration_of(f: dict[str, Any]) -> tuple[float, Array, Callable[[int], bytes]]:
    """Ceiling height, base_from_camera (7,) and what makes a CameraCalibration, from the reply of `/calibration`.

    Raises:
        BusError: it has other fields.
    """
    from ceilvo.calibration import Calibration, NoiseCurves
    from ceilvo.camera import CameraModel
    from ceilvo.drivers.recording.scene import lens, mount

    try:
        camera = CameraModel(**{**f["camera"], "distortion": tuple(f["camera"]["distortion"])})
        projection = np.array(f["projection"], np.float64).reshape(3, 4)
        made = Calibration(camera, projection, NoiseCurves((0.0,), (0.0,), 0.0, 0.0, 0.0))
        return float(f["ceiling_height_m"]), mount(made), lambda ns: lens(ns, made)
    except (KeyError, TypeError, ValueError) as e:
        raise BusError(f"calibration message: {type(e).__name__} {one_line(str(e))}") from e


def serve(
    config: Zenoh,
    robot: str,
    host: str,
    port: int,
    stop: threading.Event,
    on_ready: Callable[[int], None] = lambda port: None,
) -> None:
    """Serve a robot until `stop` is set.

    Args:
        port: 0 for a free one.
        on_ready: is told the port that Foxglove connects to.

    Raises:
        ConfigError: foxglove-sdk is not installed.
        BusError: the port is taken, or Zenoh cannot be used as configured.
    """
    try:
        import foxglove as sdk
    except ImportError as e:
        raise ConfigError("view: found no foxglove-sdk, expected it; pip install 'ceilvo[foxglove]'") from e
    context = sdk.Context()
    # All before the first client: the server forgets some of what clients ask of channels that come later.
    channels = {channel: _opened(sdk, channel, context) for channel in CHANNELS}
    try:
        server = sdk.start_server(name=f"ceilvo {robot}", host=host, port=port, context=context)
    except Exception as e:  # foxglove-sdk's own
        raise BusError(f"view: {host}:{port} cannot be listened on: {one_line(str(e))}; choose another --port") from e

    def log_to(channel: mcap_file.Channel, data: bytes, unix_ns: int) -> None:
        channels[channel].log(data, log_time=unix_ns)

    try:
        follow(config, robot, log_to, stop, lambda: on_ready(server.port))
    finally:
        server.stop()


def _opened(sdk: Any, channel: mcap_file.Channel, context: Any) -> Any:
    encoding = "protobuf" if channel.encoding == "protobuf" else "jsonschema"
    schema = sdk.Schema(name=channel.schema_name, encoding=encoding, data=channel.schema or b'{"type":"object"}')
    return sdk.Channel(channel.topic, schema=schema, message_encoding=channel.encoding, context=context)


def follow(
    config: Zenoh,
    robot: str,
    log_to: Callable[[mcap_file.Channel, bytes, int], None],
    stop: threading.Event,
    on_ready: Callable[[], None] = lambda: None,
    idle: Callable[[], None] = lambda: None,
    at_end: Callable[[], None] = lambda: None,
) -> None:
    """Give all that a robot says to `log_to`, as View does, until `stop` is set.

    Args:
        idle: called several times a second, in the same thread as `log_to`.
        at_end: called there when `stop` is set, before Zenoh is left, which may take a while.

    Raises:
        BusError: Zenoh cannot be used as configured.
    """
    view, quiet, due = View(log_to), QuietLog(log, 0.2, 5), {"scene": 0.0, "calibration": 0.0}
    with Feed(config, robot, TOPICS) as feed:
        on_ready()

        def take(topic: str, payload: bytes) -> None:
            if topic == ALIVE:
                due["calibration"] = 0.0
            try:
                if topic in {t.value for t in TOPICS}:
                    view.take(topic, payload)
            except BusError as e:
                quiet.warning(str(e))

        def now_and_then() -> None:
            now = time.monotonic()
            if not view.has_calibration and now >= due["calibration"]:
                due["calibration"] = now + _ASK_AGAIN_S
                answer = feed.ask("calibration")
                if answer is not None and answer[0]:
                    view.calibration(answer[1])
            if now >= due["scene"]:
                due["scene"] = now + _SCENE_S
                view.scene()
            idle()

        feed.each(stop, take, now_and_then)
        at_end()
