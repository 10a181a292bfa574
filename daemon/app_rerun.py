"""`ceilvod replay FILE.mcap`: recorded inputs through the same pipeline, compared with what came of them then."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.calibration_file import parse_calibration
from ceilvo.config import Config
from ceilvo.config_file import parse_config
from ceilvo.daemon.app_record import versions
from ceilvo.daemon.app_replay import progress, report
from ceilvo.daemon.inputs import FrameInput, Input, Silence, read_input
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay import Outputs, replay
from ceilvo.daemon.trajectory import Alignment, estimate_json
from ceilvo.drivers import foxglove, mcap_file
from ceilvo.drivers.mcap_reader import Recording, open_recording
from ceilvo.errors import FileFormatError
from ceilvo.types import Estimate, Frame

RECORDING_SUFFIX = ".mcap"


@dataclass(frozen=True)
class Rerun:
    """What to replay. None and () take what was recorded."""

    file: Path
    config: Config | None = None
    overrides: tuple[str, ...] = ()
    calibration: Calibration | None = None


@dataclass
class _Tally:
    """What was read on the way.

    Attributes:
        recorded: hash of the recorded estimate by number of its input.
        numbers: of the inputs that give an estimate, in order.
        missing: inputs that the recorder had dropped.
    """

    recorded: dict[int, int] = field(default_factory=dict)
    numbers: list[int] = field(default_factory=list)
    missing: int = 0


def replay_run(run: Rerun, outputs: Outputs, reference: Path | None, align: Alignment) -> int:
    """Returns the exit code: 1 when the estimates should be the recorded ones and are not."""
    recording = open_recording(run.file)
    frames = recording.metadata.get("frames", "none")
    if frames == "none":
        raise FileFormatError(f"{run.file}: no pictures in it (recorder.frames: none), so there is nothing to replay")
    config = run.config
    if config is None:
        config = parse_config(recording.text(mcap_file.CONFIG), f"{run.file}:config.yaml", run.overrides)
    calibration = run.calibration
    if calibration is None:
        calibration = parse_calibration(recording.text(mcap_file.CALIBRATION), f"{run.file}:calibration.yaml")
    cv2.setNumThreads(config.service.opencv_threads)
    pipeline = Pipeline(calibration, config, np.random.default_rng(config.service.seed))
    tally = _Tally()
    inputs = _inputs(recording, tally) if frames == "lossless" else _seen(recording)
    estimates = replay(inputs, pipeline, calibration, outputs, progress())
    report(estimates, config.service.seed, run.file, reference, align)
    if recording.problem:
        print(f"{run.file}: {recording.problem}; {len(estimates)} estimates up to there")
    text, same = _verdict(run, recording, tally, estimates)
    print(f"recorded   {text}")
    return 0 if same else 1


def _inputs(recording: Recording, tally: _Tally) -> Iterator[Input]:
    """Every input of a lossless recording."""
    pixels: dict[int, bytes] = {}
    expected: int | None = 0 if recording.metadata.get("start") == "fresh" else None
    for message in recording.messages():
        if message.topic == mcap_file.FRAMES.topic:
            pixels = {message.number: message.data}
        elif message.topic == mcap_file.ESTIMATE.topic:
            tally.recorded[message.number] = hash(message.data)
        elif message.topic == mcap_file.INPUT.topic:
            number, given = read_input(message.data, _Pixels(pixels.get(message.number)))
            tally.missing += 0 if expected is None else number - expected
            expected = number + 1
            if isinstance(given, FrameInput | Silence):
                tally.numbers.append(number)
            yield given


@dataclass(frozen=True)
class _Pixels:
    data: bytes | None

    def __call__(self, seq: int, stamp_ns: int) -> Frame:
        if self.data is None:
            raise FileFormatError(f"frame {seq}: its pixels are missing; the recording is damaged")
        return Frame(seq, stamp_ns, foxglove.read_raw_image(self.data))


def _seen(recording: Recording) -> Iterator[Input]:
    """The pictures of a recording that has not all of them, and only something like them."""
    picture: NDArray[np.uint8] | None = None
    blank = np.zeros((0, 0), np.uint8)
    for message in recording.messages():
        if message.topic == mcap_file.PICTURES.topic:
            picture = foxglove.read_compressed_image(message.data)
        elif message.topic == mcap_file.INPUT.topic:
            _, given = read_input(message.data, lambda seq, stamp_ns: Frame(seq, stamp_ns, blank))
            if not isinstance(given, FrameInput | Silence):
                yield given
            elif isinstance(given, FrameInput) and picture is not None:
                yield FrameInput(Frame(given.frame.seq, given.frame.stamp_ns, picture))
                picture = None


def _verdict(run: Rerun, recording: Recording, tally: _Tally, estimates: list[Estimate]) -> tuple[str, bool]:
    """One line, and False when there is a difference that should not be."""
    why = _not_comparable(run, recording)
    if why:
        return f"not compared: {why}", True
    if tally.missing:
        return f"not compared: {tally.missing} inputs are missing, the disk was too slow for them", True
    pairs = zip(tally.numbers, estimates, strict=True)
    same = [tally.recorded.get(n) == hash(estimate_json(e).encode()) for n, e in pairs if n in tally.recorded]
    if all(same):
        return f"{len(same)} of {len(same)} estimates are the same to the last bit", True
    then, now = recording.metadata, versions()
    differs = ", ".join(f"{k} was {then.get(k)}, is {v}" for k, v in now.items() if then.get(k) != v)
    first = same.index(False)
    return f"{sum(same)} of {len(same)} estimates are the same, the first other one is {first}" + (
        f"; {differs}" if differs else "; the versions are the same: was the program changed?"
    ), False


def _not_comparable(run: Rerun, recording: Recording) -> str:
    if run.config is not None or run.overrides or run.calibration is not None:
        return "another configuration or calibration was asked for"
    if recording.metadata.get("frames") != "lossless":
        return "its pictures are JPEG, and not all of them: what was seen, not what was estimated"
    if recording.metadata.get("start") != "fresh":
        return "it begins in the middle of a run, whose map and pose are only where this starts from"
    return ""
