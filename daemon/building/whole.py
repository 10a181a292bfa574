"""`ceilvod map build`: recordings of drives become one refined map."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from ceilvo.calibration import Calibration
from ceilvo.calibration_file import render_calibration
from ceilvo.daemon.building.calibrations import Eyes
from ceilvo.daemon.building.joined import join_all, said
from ceilvo.daemon.building.recordings import Driven, driven, runs_of
from ceilvo.daemon.building.refining import Refinement, progress, refine_all
from ceilvo.daemon.building.report import told
from ceilvo.daemon.building.typed import Prefixed
from ceilvo.daemon.editing.editor import show
from ceilvo.daemon.editing.joining import matches_by_id
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import copy_of, keep_copy, open_map
from ceilvo.errors import CeilvoError, one_line
from ceilvo.tasks.workers import Workers, each
from ceilvo.tasks.workers import progress as counting

FEWEST_POSES = 5
"""Key poses of a drive that is worth joining; chosen: a metre."""


@dataclass(frozen=True)
class Built:
    """The map of all drives that could be joined, and by which calibrations they saw."""

    content: MapContent
    eyes: Eyes


def build(options: argparse.Namespace) -> int:
    """The command; 0, or an error."""
    into: Path = options.into
    found = _there(into, options.floor)
    drives = _replayed(options.recordings, Workers.of(options))
    built = _joined(drives, found, options)
    done = refine_all([built.content], Refinement(built.eyes, on_round=progress()))
    for line in told(done):
        print(line)
    after, before = done.after[0], built.content if found is None else found[0]
    what = one_line(f"build {' '.join(p.name for p in options.recordings)}")
    if options.png is not None:
        show(options.png, before, after, matches_by_id(before.landmarks, after.landmarks), what)
    if options.dry_run:
        print(f"{into}: would be written; nothing was")
        return 0
    with open_map(into, after.floor, create=True) as db:
        if found is not None:
            keep_copy(db)
        db.edit(after, what, "" if found is None else found[1])
        if found is None:
            keep_copy(db)
        kept = db.content()
    print(f"{into}: holds {len(kept.landmarks)} landmarks and {sum(map(len, kept.key_poses))} key poses")
    return 0


def _there(into: Path, floor: str | None) -> tuple[MapContent, str] | None:
    """The map that is there, with its hash."""
    if not (os.path.lexists(into) or copy_of(into).exists()):
        return None
    with open_map(into, floor) as db:
        return (db.content(), db.hash) if db.version else None


def _replayed(recordings: Sequence[Path], workers: Workers) -> list[Driven]:
    """Every run by the daemon's own steps, in the order of the recordings whoever did it."""
    for path in recordings:
        if not path.exists():
            raise CeilvoError(f"{path}: no such recording, expected an MCAP file or a folder of them")
    runs = runs_of(list(recordings))
    if not runs:
        raise CeilvoError(f"{', '.join(map(str, recordings))}: no recording in it, expected MCAP files")
    tick, done = counting("recordings", len(runs)), dict[int, Driven]()
    for k, drive in each(driven, runs, workers):
        done[k] = drive
        tick()
    for k in range(len(runs)):
        d = done[k]
        poses, landmarks = sum(map(len, d.content.key_poses)), len(d.content.landmarks)
        print(f"{d.source.name}: {d.frames} frames, {d.good} localised, {poses} key poses of {landmarks} landmarks")
    return [done[k] for k in range(len(runs))]


def _joined(drives: Sequence[Driven], found: tuple[MapContent, str] | None, options: argparse.Namespace) -> Built:
    """All in the frame of the map that is there, else of the drive with the most key poses."""
    usable = [d for d in drives if sum(map(len, d.content.key_poses)) >= FEWEST_POSES]
    known = set() if found is None else {s.name for s in found[0].sessions}
    new = [d for d in usable if d.content.sessions[0].name not in known]
    new.sort(key=lambda d: -len(d.content.key_poses[0]))
    if not new:
        raise CeilvoError(
            f"nothing new: {len(drives)} drives, {len(drives) - len(usable)} with fewer than {FEWEST_POSES} key poses, "
            "the others are in the map; drive where the robot knows its place"
        )
    names = [d.source.name for d in new]
    contents = [d.content for d in new]
    if found is not None:
        contents, names = [found[0], *contents], [str(options.into), *names]
    whole, done, refused = join_all(contents)
    for k, frame in done:
        print(f"{names[k]}: {said(frame)}")
    for k, frame in refused:
        print(f"{names[k]}: not joined: {frame.refused}")
    if found is not None and not done:
        raise CeilvoError(f"{options.into}: none of the drives could be joined to it")
    floor = options.floor if found is None and options.floor is not None else whole.floor
    eyes = _eyes(new, found, options)
    return Built(replace(whole, floor=floor), eyes)


def _eyes(drives: Sequence[Driven], found: tuple[MapContent, str] | None, options: argparse.Namespace) -> Eyes:
    """Each different calibration once, and for sessions that are in the map already, those that were named."""
    old = Eyes.read(options.calibration, options.config) if found is not None and found[0].key_poses else Eyes((), ())
    files, calibrations, named = list(old.files), list(old.calibrations), dict[str, int]()
    texts: dict[str, int] = {_text(c): k for k, c in enumerate(calibrations)}
    for d in drives:
        at = texts.setdefault(_text(d.calibration), len(calibrations))
        if at == len(calibrations):
            calibrations.append(d.calibration)
            files.append(Prefixed("", Path(f"{d.source}:calibration.yaml")))
        named[d.content.sessions[0].name] = at
    return Eyes(tuple(files), tuple(calibrations), named, len(old.files))


def _text(calibration: Calibration) -> str:
    return render_calibration(calibration, "calibration")
