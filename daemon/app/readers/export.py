"""`ceilvod export`: a recording as a ROS 2 bag, with what the daemon would have said to ROS 2 meanwhile."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.replay.rerun import Rerun, opened
from ceilvo.daemon.replay.trajectory import read_estimate
from ceilvo.drivers.recording import foxglove, mcap_file
from ceilvo.drivers.recording.mcap_reader import Recorded, Recording
from ceilvo.drivers.ros2.bag import Bag
from ceilvo.drivers.ros2.cdr import Cdr
from ceilvo.drivers.ros2.conversion import Conversion
from ceilvo.drivers.ros2.endpoints import endpoints
from ceilvo.drivers.ros2.speech import Speech
from ceilvo.errors import FileFormatError
from ceilvo.types import Array, Estimate, Landmarks, State

_WHOLE_CHAIN = "ros2.odom_to_base=true"
"""Whoever else publishes odom -> base on the robot is not in the recording."""


def export_ros2(source: Path, out: Path, overrides: tuple[str, ...]) -> int:
    """Write a bag; returns the exit code.

    Args:
        source: a recording, or a folder with the files of one run.
        overrides: of the recorded configuration, such as ros2.pose_topic=amcl_pose.

    Raises:
        FileFormatError: the recording cannot be read, the bag cannot be written.
        ConfigError: rosbags is not installed.
    """
    run = opened(Rerun(source, overrides=(_WHOLE_CHAIN, *overrides)))
    cdr = Cdr(run.config.ros2.distribution)
    with Bag(out, cdr) as bag:
        told = _Told(run.config, run.calibration, cdr, bag)
        for recording in run.recordings:
            told.all_of(recording)
        if not bag.messages:
            raise FileFormatError(f"{source}: has no estimates, expected a recording of a drive; nothing was written")
    for line in told.lines(run.recordings):
        sys.stdout.write(f"{line}\n")
    sys.stdout.write(f"{out}: {bag.messages} messages, {told.estimates} poses\n")
    return 0


class _Told:
    """Topic by topic; the robot's place is known from the estimates before."""

    def __init__(self, config: Config, calibration: Calibration, cdr: Cdr, bag: Bag) -> None:
        self._bag, self._config = bag, config.ros2
        self._ends = endpoints(config.ros2, config.robot.name)
        self._make = Conversion(config.ros2, config.robot.name, calibration, cdr)
        self._speech = Speech(config.ros2, self._make, self._ends)
        self._last: Estimate | None = None
        self._began = False
        self.estimates = self.unknown = 0
        self._of_topic: Mapping[str, Callable[[Recorded], None]] = {
            mcap_file.ESTIMATE.topic: self._estimate,
            mcap_file.HEALTH.topic: self._health,
            mcap_file.SCENE.topic: self._scene,
            mcap_file.FRAMES.topic: self._frame,
            mcap_file.PICTURES.topic: self._picture,
        }

    def all_of(self, recording: Recording) -> None:
        for message in recording.messages():
            do = self._of_topic.get(message.topic)
            if do is None:
                continue
            try:
                do(message)
            except FileFormatError as e:
                raise FileFormatError(f"{recording.path}: {e}") from e

    def lines(self, recordings: Sequence[Recording]) -> list[str]:
        """What people should know of the whole."""
        out = [f"{r.path}: {r.problem}; all up to there was read" for r in recordings if r.problem]
        if self.unknown:
            out.append(f"{self.unknown} estimates without a finite pose were left out")
        return out

    def _estimate(self, message: Recorded) -> None:
        estimate = read_estimate(message.data)
        if not np.isfinite(np.concatenate([estimate.pose, estimate.odom, estimate.twist])).all():
            self.unknown += 1
            return
        self._begin(message.log_ns)
        self._last = estimate
        self.estimates += 1
        for said in self._speech.motion(estimate, message.log_ns):
            self._bag.write(*said)

    def _begin(self, unix_ns: int) -> None:
        if self._began:
            return
        self._began = True
        static = self._make.tf(self._make.base_from_camera(unix_ns))
        self._bag.write(self._ends.tf_static, static, unix_ns)

    def _health(self, message: Recorded) -> None:
        try:
            body = json.loads(message.data)
            state, counters = State[body["state"]], dict(body["counters"])
        except (KeyError, TypeError, ValueError, RecursionError) as e:
            raise FileFormatError(f"health {message.data[:60]!r}: {type(e).__name__}; the recording is damaged") from e
        self._bag.write(*self._speech.health(message.log_ns, state, counters))

    def _scene(self, message: Recorded) -> None:
        if self._last is None:
            return
        at_ns, near_m = message.log_ns, self._last.pose[:2]
        xy_m, particles = foxglove.read_scene(message.data)
        self._bag.write(self._ends.landmarks, self._make.landmarks(at_ns, _landmarks(xy_m), near_m), at_ns)
        self._bag.write(self._ends.particles, self._make.particles(at_ns, particles), at_ns)

    def _frame(self, message: Recorded) -> None:
        """Pixels without loss stay so."""
        ok, png = cv2.imencode(".png", foxglove.read_raw_image(message.data), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not ok:
            raise FileFormatError("a picture cannot be encoded; the recording is damaged")
        self._image(message.log_ns, np.asarray(png, np.uint8).tobytes(), "png")

    def _picture(self, message: Recorded) -> None:
        self._image(message.log_ns, *foxglove.compressed_bytes(message.data))

    def _image(self, unix_ns: int, data: bytes, kind: str) -> None:
        self._bag.write(self._ends.image, self._make.image(unix_ns, data, kind), unix_ns)
        self._bag.write(self._ends.camera_info, self._make.camera_info(unix_ns), unix_ns)


def _landmarks(xy_m: Array) -> Landmarks:
    """At (L, 2); kinds and covariances are not in a scene."""
    count = len(xy_m)
    one, cov = np.ones(count, np.int64), np.zeros((count, 2, 2))
    return Landmarks(np.arange(count), xy_m, cov, 0 * one, one)
