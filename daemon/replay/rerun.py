"""`ceilvod replay FILE.mcap`: recorded inputs through the same pipeline, compared with what came of them then."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.calibration_file import parse_calibration
from ceilvo.config import Config
from ceilvo.config.reader import parse_config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.command import progress, report
from ceilvo.daemon.replay.inputs import Continuation, FrameInput, Input, Sighting, Silence, check_plausible, read_input
from ceilvo.daemon.replay.recording import versions
from ceilvo.daemon.replay.replay import Outputs, replay
from ceilvo.daemon.replay.snapshot import read_value
from ceilvo.daemon.replay.trajectory import Alignment, estimate_json
from ceilvo.drivers.recording import foxglove, mcap_file
from ceilvo.drivers.recording.mcap_reader import Recorded, Recording, open_recording
from ceilvo.errors import FileFormatError, one_line
from ceilvo.types import Crossings, Estimate, Frame

_SUFFIX = ".mcap"
_ANCESTORS, _NO_ANCESTORS = re.compile(rb'"unique_ancestors":\d+'), b'"unique_ancestors":null'
"""ceilvo 0.1 gave a number for filters whose particles have no ancestors."""
_BLANK = np.zeros((0, 0), np.uint8)


@dataclass(frozen=True)
class Rerun:
    """What to replay. None and () take what was recorded.

    Attributes:
        source: names it.
        files: of one run, in their order; (): source, or all in it.
    """

    source: Path
    config: Config | None = None
    overrides: tuple[str, ...] = ()
    calibration: Calibration | None = None
    files: tuple[Path, ...] = ()


@dataclass
class Tally:
    """What was read on the way.

    Attributes:
        recorded: hash of the recorded estimate by number of its input; the second as today's program would write it.
        numbers: of the inputs that give an estimate, in order.
        missing: inputs that the recorder had dropped.
        begun_ns: since 1970, of the first input.
        unix_minus_monotonic_ns: of the run.
        why_not: why this cannot give the recorded estimates; empty when it should.
    """

    recorded: dict[int, tuple[int, int]] = field(default_factory=dict)
    numbers: list[int] = field(default_factory=list)
    missing: int = 0
    begun_ns: int = 0
    unix_minus_monotonic_ns: int = 0
    why_not: str = ""


def is_recording(source: Path) -> bool:
    """An MCAP file, or a folder with some."""
    return source.suffix == _SUFFIX if not source.is_dir() else any(source.glob(f"*{_SUFFIX}"))


def runs_in(source: Path) -> list[tuple[Path, ...]]:
    """The files of each run in a folder, in the order of their names; of a file itself.

    Raises:
        FileFormatError: one is no recording.
    """
    runs: list[list[Recording]] = []
    for recording in map(open_recording, sorted(source.glob(f"*{_SUFFIX}")) if source.is_dir() else [source]):
        if not runs or _begins(recording, runs[-1][0]):
            runs.append([])
        runs[-1].append(recording)
    return [tuple(r.path for r in run) for run in runs]


def _begins(recording: Recording, first: Recording) -> bool:
    """Whether it is of another run than the one before."""
    return recording.metadata.get("start") == "fresh" or recording.attachments != first.attachments


@dataclass(frozen=True)
class Opened:
    """A run that can be replayed.

    Attributes:
        recordings: its files.
        inputs: what the pipeline was given then, once.
    """

    recordings: tuple[Recording, ...]
    config: Config
    calibration: Calibration
    inputs: Iterator[Input]
    tally: Tally

    def pipeline(self) -> Pipeline:
        """A new one, as the run began with."""
        return Pipeline(self.calibration, self.config, np.random.default_rng(self.config.service.seed))


def opened(run: Rerun) -> Opened:
    """What a run was recorded with.

    Raises:
        FileFormatError: a file cannot be read, or is of another run.
    """
    recordings = _recordings(run)
    first, tally = recordings[0], Tally()
    config = run.config
    if config is None:
        config = parse_config(first.text(mcap_file.CONFIG), f"{first.path}:config.yaml", run.overrides)
    calibration = run.calibration
    if calibration is None:
        calibration = parse_calibration(first.text(mcap_file.CALIBRATION), f"{first.path}:calibration.yaml")
    return Opened(tuple(recordings), config, calibration, _inputs(recordings, tally), tally)


def replay_run(run: Rerun, outputs: Outputs, reference: Path | None, align: Alignment) -> int:
    """Returns the exit code: 1 when the estimates should be the recorded ones and are not."""
    text, code = replayed(run, outputs, reference, align, progress())
    sys.stdout.write(text)
    return code


def replayed(
    run: Rerun,
    outputs: Outputs,
    reference: Path | None,
    align: Alignment,
    progress: Callable[[int], None] = lambda _done: None,
) -> tuple[str, int]:
    """What replay_run() prints, and its exit code."""
    given = opened(run)
    cv2.setNumThreads(given.config.service.opencv_threads)
    pipeline, source = given.pipeline(), str(run.source)
    estimates = replay(given.inputs, pipeline, given.calibration, outputs, progress, source)
    lines = [report(estimates, given.config.service.seed, run.source, reference, align)]
    for recording in given.recordings:
        if recording.problem:
            lines.append(f"{recording.path}: {recording.problem}; all up to there was read\n")
    text, same = _verdict(run, given.recordings[0], given.tally, estimates)
    return "".join([*lines, f"recorded   {text}\n"]), 0 if same else 1


def _recordings(run: Rerun) -> list[Recording]:
    """The file, or those of a folder in the order of their names, which must be of one run."""
    source = run.source
    files = run.files or (sorted(source.glob(f"*{_SUFFIX}")) if source.is_dir() else [source])
    recordings = [open_recording(f) for f in files]
    for r in recordings[1:]:
        if _begins(r, recordings[0]):
            raise FileFormatError(f"{r.path}: begins another run than {files[0].name}; replay it by itself")
    return recordings


def _inputs(recordings: Sequence[Recording], tally: Tally) -> Iterator[Input]:
    """Every input, with the frame if it was kept, else what vision had found in it, else whatever picture there is."""
    kept = {t.topic: _Kept() for t in (mcap_file.FRAMES, mcap_file.FEATURES, mcap_file.PICTURES)}
    expected = 0
    for recording, message in ((r, m) for r in recordings for m in r.messages()):
        if message.topic in kept:
            kept[message.topic].put(message)
        elif message.topic == mcap_file.ESTIMATE.topic:
            tally.recorded[message.number] = hash(message.data), hash(_ANCESTORS.sub(_NO_ANCESTORS, message.data))
        elif message.topic == mcap_file.INPUT.topic:
            try:
                number, found = _input(message, kept, expected, tally)
            except FileFormatError as e:
                raise FileFormatError(f"{recording.path}: {e}") from e
            expected = number + 1
            tally.begun_ns = tally.begun_ns or message.log_ns
            if isinstance(found, FrameInput | Sighting | Silence):
                tally.numbers.append(number)
                stamp_ns = found.frame.stamp_ns if isinstance(found, FrameInput) else found.stamp_ns
                tally.unix_minus_monotonic_ns = message.log_ns - stamp_ns
            if found is not None:
                yield found


def _input(message: Recorded, kept: Mapping[str, _Kept], expected: int, tally: Tally) -> tuple[int, Input | None]:
    """A message of the inputs with its number; None for a frame of which nothing was kept.

    Raises:
        FileFormatError: it is damaged.
    """
    number, given = read_input(message.data, lambda seq, stamp_ns: Frame(seq, stamp_ns, _BLANK))
    if not (number == 0 or expected or isinstance(given, Continuation)):
        tally.why_not = "it begins in the middle of a run, without the state that there was"
    tally.missing += number - expected if expected else 0
    found: Input | None = given
    if isinstance(given, FrameInput):
        pixels, features, picture = (k.take(number) for k in kept.values())
        found = _whole(given, pixels, features)
        if found is None:
            found = _seen(given, picture)
            tally.why_not = "it has JPEG pictures at most, not of every frame, and recorder.features was off"
    if found is not None:
        check_plausible(found)
    return number, found


class _Kept:
    """The newest message of a topic, for the input of the same number."""

    def __init__(self) -> None:
        self._last: Recorded | None = None

    def put(self, message: Recorded) -> None:
        self._last = message

    def take(self, number: int) -> bytes | None:
        last = self._last
        return last.data if last is not None and last.number == number & 0xFFFFFFFF else None


def _whole(given: FrameInput, pixels: bytes | None, features: bytes | None) -> FrameInput | Sighting | None:
    frame = given.frame
    if pixels is not None:
        return FrameInput(Frame(frame.seq, frame.stamp_ns, foxglove.read_raw_image(pixels)), given.wheels, given.heard)
    if features is not None:
        return Sighting(frame.stamp_ns, read_value(features, Crossings), given.wheels, given.heard)
    return None


def _seen(given: FrameInput, picture: bytes | None) -> FrameInput | None:
    """A picture instead of the frame: something like it, and not of every frame, so without wheels."""
    if picture is None:
        return None
    gray: NDArray[np.uint8] = foxglove.read_compressed_image(picture)
    return FrameInput(Frame(given.frame.seq, given.frame.stamp_ns, gray))


def _verdict(run: Rerun, first: Recording, tally: Tally, estimates: list[Estimate]) -> tuple[str, bool]:
    """One line, and False when there is a difference that should not be."""
    if run.config is not None or run.overrides or run.calibration is not None:
        return "not compared: another configuration or calibration was asked for", True
    if tally.missing:
        return f"not compared: {tally.missing} inputs are missing, the disk was too slow for them", True
    if tally.why_not:
        return f"not compared: {tally.why_not}", True
    pairs = zip(tally.numbers, estimates, strict=True)
    same = [hash(estimate_json(e).encode()) in tally.recorded[n] for n, e in pairs if n in tally.recorded]
    if all(same):
        return f"{len(same)} of {len(same)} estimates are the same to the last bit", True
    then, now = first.metadata, versions()
    differs = ", ".join(f"{k} was {one_line(then.get(k))}, is {v}" for k, v in now.items() if then.get(k) != v)
    why = differs or "the versions are the same: was the program changed?"
    return (
        f"{sum(same)} of {len(same)} estimates are the same, the first other one is {same.index(False)}; {why}",
        False,
    )
