"""A recording through the daemon's own steps: key poses and landmarks, in a frame of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path

import cv2
import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.daemon.map.database.content import MapContent, Session
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.refinement.key_pose_taker import KeyPoseTaker
from ceilvo.daemon.refinement.survey import index_of
from ceilvo.daemon.replay.inputs import FrameInput, Input, Sighting
from ceilvo.daemon.replay.replay import Outputs, replay
from ceilvo.daemon.replay.rerun import Rerun, opened, runs_in
from ceilvo.types import GOOD, Array, Estimate, Landmarks

_NS = 1e-9


@dataclass(frozen=True)
class Driven:
    """One drive.

    Attributes:
        source: the recording.
        content: landmarks that its key poses show, and these; in the frame of that drive.
        calibration: by which the robot saw.
        frames, good: how many, and of how many the pose could be used.
    """

    source: Path
    content: MapContent
    calibration: Calibration
    frames: int
    good: int


def runs_of(sources: list[Path]) -> list[Rerun]:
    """Every run of recordings and of folders of them.

    Raises:
        FileFormatError: one is no recording.
    """
    return [Rerun(files[0].resolve(), files=tuple(f.resolve() for f in files)) for s in sources for files in runs_in(s)]


def driven(run: Rerun) -> Driven:
    """Replay a run and take key poses.

    Raises:
        FileFormatError: the recording is damaged.
    """
    given = opened(run)
    cv2.setNumThreads(given.config.service.opencv_threads)
    pipeline, taker = given.pipeline(), KeyPoseTaker("")

    def watch(given_now: Input, estimate: Estimate) -> None:
        if isinstance(given_now, Sighting):
            taker.add(pipeline, estimate, given_now.crossings)
        elif isinstance(given_now, FrameInput) and pipeline.vision.view is not None:
            taker.add(pipeline, estimate, pipeline.vision.view.crossings)

    estimates = replay(given.inputs, pipeline, given.calibration, Outputs(), source=str(run.source), watch=watch)
    good = sum(e.state in GOOD for e in estimates)
    axis_rad = pipeline.relocaliser.state.map_axis_rad or 0.0
    begun = datetime.fromtimestamp(_NS * given.tally.begun_ns, tz=timezone.utc).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    taken = replace(taker.taken(), session=f"{given.config.robot.name}/{begun}")
    content = _content(pipeline.landmarks(), axis_rad, taken, given.tally.unix_minus_monotonic_ns)
    return Driven(run.source, content, given.calibration, len(estimates), good)


def _content(landmarks: Landmarks, axis_rad: float, key_poses: KeyPoses, unix_ns: int) -> MapContent:
    """What the key poses show of the map."""
    ordered = landmarks.of(np.argsort(landmarks.ids, kind="stable"))
    known = ordered.of(np.isin(ordered.ids, key_poses.landmark))
    at_s = np.asarray(_NS * (key_poses.stamp_ns + unix_ns), np.float64)
    sessions = (Session(key_poses.session, float(at_s[0]), float(at_s[-1])),) if len(key_poses) else ()
    return MapContent(known, _seen_s(known, key_poses, at_s), axis_rad, (key_poses,) if sessions else (), sessions)


def _seen_s(landmarks: Landmarks, key_poses: KeyPoses, at_s: Array) -> Array:
    """(L, 2) when each was first and last in a key pose."""
    out = np.column_stack([np.full(len(landmarks), np.inf), np.zeros(len(landmarks))])
    at = index_of(key_poses.landmark, landmarks.ids)
    named = at >= 0
    np.minimum.at(out[:, 0], at[named], at_s[key_poses.view[named]])
    np.maximum.at(out[:, 1], at[named], at_s[key_poses.view[named]])
    return out
