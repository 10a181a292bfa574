"""What the running daemon records: every input of the pipeline and everything it says, for one file or for the ring."""

from __future__ import annotations

import json
import logging
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ceilvo import __version__
from ceilvo.calibration import Calibration
from ceilvo.calibration_file import render_calibration
from ceilvo.config import Config
from ceilvo.config.rendering import render_config
from ceilvo.daemon.pipeline import Pipeline, PipelineState
from ceilvo.daemon.replay.inputs import Continuation, FrameInput, Input, SetPose, input_json
from ceilvo.daemon.replay.snapshot import SnapshotError, freeze, snapshot_json, value_json
from ceilvo.daemon.replay.trajectory import estimate_json
from ceilvo.daemon.vision.kernel import COMPILED
from ceilvo.drivers.pictures import jpeg
from ceilvo.drivers.ports import Base, Clock
from ceilvo.drivers.recording import foxglove, mcap_file
from ceilvo.drivers.recording.mcap_file import Head, Message
from ceilvo.drivers.recording.recorder import Recorder, RecorderCounters
from ceilvo.drivers.recording.scene import CAMERA_FRAME, Scenery
from ceilvo.drivers.recording.storage import Ring, SingleFile
from ceilvo.drivers.telegrams import BaseStatus, PoseTelegram
from ceilvo.errors import BaseLinkError, FileFormatError
from ceilvo.json_values import json_value
from ceilvo.types import GOOD, Array, Estimate, Frame, State

log = logging.getLogger("ceilvo")

_PATIENCE_S = 3.0
"""By which the flight recorder begins at the latest, while there is no good pose; chosen."""
_SILENT_BASE_S = 1.0
"""A base silent for longer is a fault worth a recording; chosen: many times its period."""

Note = Callable[[str], None]


class RecordingTap:
    """Turns what happens in the daemon into messages for a recorder. Thread-safe; no method waits or raises."""

    def __init__(
        self,
        recorder: Recorder,
        clock: Clock,
        scenery: Scenery,
        frames: str,
        features: bool = False,
        jpeg_rate_hz: float = 5.0,
    ) -> None:
        self._recorder, self._clock, self._frames, self._features = recorder, clock, frames, features
        self._picture_period_ns = int(1e9 / jpeg_rate_hz)
        self._next_picture_ns = 0
        self._number = 0
        self._scenery = scenery
        self._last: Estimate | None = None
        self._faults: frozenset[str] = frozenset()

    def start(self) -> None:
        self._recorder.start()

    def stop(self, crashed: bool) -> None:
        if crashed:
            self._recorder.fault("crash")
        if not self._recorder.stop():
            log.warning("the recorder did not end in time; its last file has no index")

    def counters(self) -> RecorderCounters:
        return self._recorder.counters()

    def input(self, given: Input, estimate: Estimate | None, pipeline: Pipeline) -> None:
        """An estimator's Tap."""
        stamp_ns = self._clock() if estimate is None else estimate.stamp_ns
        number, self._number = self._number, self._number + 1
        messages: list[Message] = []
        size = 0
        if isinstance(given, FrameInput):
            messages = self._pictures(given.frame, number)
            size = given.frame.gray.nbytes if messages else 0
            if self._features:
                crossings = None if pipeline.vision.view is None else pipeline.vision.view.crossings
                messages.append(Message(mcap_file.FEATURES, stamp_ns, lambda _: value_json(crossings), number))
            given = replace(given, frame=replace(given.frame, gray=given.frame.gray[:0]))
        messages.append(Message(mcap_file.INPUT, stamp_ns, lambda _: input_json(given, number), number))
        if estimate is not None:
            messages.append(Message(mcap_file.ESTIMATE, stamp_ns, lambda _: estimate_json(estimate).encode(), number))
            if np.isfinite(estimate.pose).all():
                messages += self._scenery.messages(estimate, lambda: _look(pipeline))
        self._recorder.put(*messages, size=size)
        if estimate is not None:
            self._watch(estimate)
            if self._recorder.due:
                self._recorder.begin(self._state(estimate, pipeline))

    def published(self, estimate: Estimate) -> None:
        """How long its stages took; a good one says that the daemon has started."""
        if estimate.state in GOOD:
            self._recorder.hurry()
        laps = dict(estimate.latency_ms)
        if laps:
            self._put(mcap_file.LATENCY, estimate.stamp_ns, {"stamp_ns": estimate.stamp_ns, "latency_ms": laps})

    def exchange(self, telegram: PoseTelegram, status: BaseStatus | None, problem: str) -> None:
        """One telegram to the base, and what came back."""
        now_ns = self._clock()
        body = {**asdict(telegram), "state": telegram.state.name, "answered": status is not None, "problem": problem}
        self._put(mcap_file.TELEGRAM, now_ns, body)
        if status is not None:
            self._put(mcap_file.BASE_STATUS, now_ns, asdict(status))

    def event(self, level: int, name: str, text: str) -> None:
        self._recorder.put(
            Message(mcap_file.EVENT, self._clock(), lambda unix_ns: foxglove.log_line(unix_ns, level, name, text))
        )

    def health(self, payload: bytes, counters: Mapping[str, object]) -> None:
        """The message as published; also looks for faults among the counters."""
        self._recorder.put(Message(mcap_file.HEALTH, self._clock(), lambda _: payload))
        faults = faults_in(counters)
        for name in sorted(faults - self._faults):
            self._recorder.fault(name)
        self._faults = faults

    def _put(self, channel: mcap_file.Channel, stamp_ns: int, body: Mapping[str, Any]) -> None:
        self._recorder.put(Message(channel, stamp_ns, lambda _: json.dumps(json_value(body)).encode()))

    def _pictures(self, frame: Frame, number: int) -> list[Message]:
        if self._frames == "lossless":
            return [Message(mcap_file.FRAMES, frame.stamp_ns, lambda unix_ns: _raw(unix_ns, frame), number)]
        if self._frames == "none":
            return []
        if frame.stamp_ns < self._next_picture_ns:
            return []
        self._next_picture_ns = max(self._next_picture_ns + self._picture_period_ns, frame.stamp_ns + 1)
        return [Message(mcap_file.PICTURES, frame.stamp_ns, lambda unix_ns: _jpeg(unix_ns, frame), number)]

    def _watch(self, estimate: Estimate) -> None:
        last, self._last = self._last, estimate
        if estimate.state is State.LOST and (last is None or last.state is not State.LOST):
            self._recorder.fault("state LOST")

    def _state(self, estimate: Estimate, pipeline: Pipeline) -> Message:
        """All that the pipeline knows now, from which a replay of a file that begins here starts."""
        number, self._number = self._number, self._number + 1
        frozen, method = freeze(pipeline), pipeline.config.filter.method

        def data(unix_ns: int) -> bytes:
            return _continuation(frozen, method, estimate, number)

        return Message(mcap_file.INPUT, estimate.stamp_ns, data, number)


class RecordedBase:
    """A Base whose telegrams are recorded."""

    def __init__(self, base: Base, tap: RecordingTap) -> None:
        self._base, self._tap = base, tap

    @property
    def is_open(self) -> bool:
        return self._base.is_open

    def open(self) -> None:
        self._base.open()

    def exchange(self, telegram: PoseTelegram) -> BaseStatus:
        try:
            status = self._base.exchange(telegram)
        except BaseLinkError as e:
            self._tap.exchange(telegram, None, str(e))
            raise
        self._tap.exchange(telegram, status, "")
        return status

    def close(self) -> None:
        self._base.close()


def faults_in(counters: Mapping[str, object]) -> frozenset[str]:
    """What of the health counters is worth keeping a recording for. A base that never answered is none."""
    age_s = counters.get("base_link_age_s")
    found = {
        "camera gone": counters.get("camera_connected") is False and bool(counters.get("camera_losses")),
        "base silent": isinstance(age_s, float) and age_s > _SILENT_BASE_S,
        "calibration stale": counters.get("calibration_stale") is True,
    }
    return frozenset(name for name, holds in found.items() if holds)


def recording_of(
    config: Config, calibration: Calibration, state_dir: Path | None, file: Path | None, clock: Clock, note: Note
) -> RecordingTap | None:
    """The recording that a run makes: a file if one is named, else the flight recorder if it has a place, else none.

    Args:
        note: called when the recorder stops by itself.

    Raises:
        FileFormatError: the file cannot be made, or is there already.
    """
    settings, scenery = config.recorder, Scenery(calibration)
    if file is not None:
        head = _head(config, calibration, clock, "recording", "lossless")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            storage = SingleFile(file, head, clock(), settings.reserve_bytes)
        except OSError as e:
            raise FileFormatError(f"{file}: cannot be recorded to: {e.strerror}; name another file") from e
        return RecordingTap(Recorder(storage, clock, note), clock, scenery, "lossless")
    if not settings.enabled or state_dir is None:
        return None
    head = _head(config, calibration, clock, "flight", settings.frames)
    recorder = Recorder(Ring(state_dir / "recorder", settings, head), clock, note, _PATIENCE_S)
    features = settings.features and settings.frames != "lossless"
    return RecordingTap(recorder, clock, scenery, settings.frames, features, settings.jpeg_rate_hz)


def versions() -> dict[str, str]:
    """What the last bits of an estimate may depend on."""
    return {
        "ceilvo": __version__,
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "kernel": "compiled" if COMPILED else "numpy",
    }


def _head(config: Config, calibration: Calibration, clock: Clock, kind: str, frames: str) -> Head:
    metadata = {**versions(), "robot": config.robot.name, "kind": kind, "frames": frames}
    files = {
        mcap_file.CONFIG: render_config(config).encode(),
        mcap_file.CALIBRATION: render_calibration(calibration, mcap_file.CALIBRATION).encode(),
    }
    return Head(metadata, files, time.time_ns() - clock(), raw_frames=frames == "lossless")


def _continuation(frozen: PipelineState, method: str, estimate: Estimate, number: int) -> bytes:
    try:
        return input_json(Continuation(snapshot_json(frozen, method)), number)
    except SnapshotError as e:
        log.error("a recording without its state, from which no replay can start: %s", e)
        return input_json(SetPose(estimate.pose, np.eye(3), "a recording begins"), number)


def _look(pipeline: Pipeline) -> tuple[Array, Array]:
    return pipeline.landmarks().xy_map_m, pipeline.filter.particles()[0]


def _raw(unix_ns: int, frame: Frame) -> bytes:
    return foxglove.raw_image(unix_ns, frame.gray, CAMERA_FRAME)


def _jpeg(unix_ns: int, frame: Frame) -> bytes:
    return foxglove.compressed_image(unix_ns, jpeg(frame.gray), "jpeg", CAMERA_FRAME)
