"""`ceilvod map anchors`: where radio anchors are, from a recorded drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from ceilvo.config import Beacons as BeaconKeys
from ceilvo.daemon.relocalisation.beacons.range_window import lever
from ceilvo.daemon.relocalisation.beacons.self_location import Located, locate_all
from ceilvo.daemon.replay.inputs import FrameInput, Input, Sighting, Silence
from ceilvo.daemon.replay.replay import Outputs, replay
from ceilvo.daemon.replay.rerun import Rerun, opened, runs_in
from ceilvo.errors import CeilvoError
from ceilvo.senses.beacon_file import read_beacons, write_beacons
from ceilvo.senses.beacons import Beacons
from ceilvo.types import Array, Estimate, State


def locate_anchors(recordings: Sequence[Path], into: Path, height_m: float, dry_run: bool) -> tuple[str, int]:
    """What to print, and the exit code: 1 when some anchor was not found. Marks of a file that is there are kept.

    Raises:
        CeilvoError: no ranges were recorded, or a file cannot be read or written.
    """
    heard: list[tuple[str, Array, float]] = []
    keys: BeaconKeys | None = None
    for source in recordings:
        for files in runs_in(source):
            keys = _collect(Rerun(files[0], files=files), heard)
    if not heard or keys is None:
        raise CeilvoError(
            f"{recordings[0]}: found no ranges while the pose was TRACKING, expected some; set beacons.ranges "
            "and record with 'ceilvod record', on a map"
        )
    found = locate_all(heard, keys.tag_z_m, height_m, keys.noise_m)
    before = read_beacons(into) if into.exists() else Beacons()
    anchors = {a.name: a for a in before.anchors} | {f.name: f.anchor for f in found if f.anchor is not None}
    if not dry_run and any(f.anchor is not None for f in found):
        write_beacons(into, replace(before, anchors=tuple(anchors[name] for name in sorted(anchors))))
    return "".join(_line(f) for f in found), 0 if all(f.anchor is not None for f in found) else 1


def _collect(run: Rerun, heard: list[tuple[str, Array, float]]) -> BeaconKeys:
    """Ranges of a run with where the tag was, between the frames around each."""
    given = opened(run)
    keys = given.config.beacons
    tag = np.array([keys.tag_x_m, keys.tag_y_m])
    last: list[Estimate] = []

    def watch(one: Input, estimate: Estimate) -> None:
        if isinstance(one, FrameInput | Sighting | Silence) and last:
            before, after = last[-1], estimate
            sure = before.state is State.TRACKING and after.state is State.TRACKING
            for r in one.heard.ranges if sure else ():
                share = (r.stamp_ns - before.stamp_ns) / max(after.stamp_ns - before.stamp_ns, 1)
                a, b = lever(before.pose, tag), lever(after.pose, tag)
                heard.append((r.anchor, a + float(np.clip(share, 0.0, 1.0)) * (b - a), r.range_m))
        last[:] = [estimate]

    cv2.setNumThreads(given.config.service.opencv_threads)
    replay(given.inputs, given.pipeline(), given.calibration, Outputs(), source=str(run.source), watch=watch)
    return keys


def _line(found: Located) -> str:
    a = found.anchor
    if a is None:
        return f"{found.name}  not found: {found.problem}\n"
    place = f"{a.x_m:.3f} m, {a.y_m:.3f} m, {a.z_m:.2f} m above the floor, +- {a.sigma_m:.3f} m"
    rest = f"offset {a.offset_m:+.3f} +- {a.offset_sigma_m:.3f} m, {found.spots} spots, rms {found.rms_m:.3f} m"
    return f"{found.name}  {place}; {rest}\n"
