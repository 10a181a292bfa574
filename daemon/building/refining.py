"""`ceilvod map refine`: maps of a database made better from all of their sessions."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ceilvo.daemon.building.anchors import floor_of, measured
from ceilvo.daemon.building.calibrations import Eyes
from ceilvo.daemon.building.report import Outcome, told, write_calibrations
from ceilvo.daemon.building.typed import TypedMark, TypedTape
from ceilvo.daemon.editing import sources
from ceilvo.daemon.editing.changes import moved
from ceilvo.daemon.editing.editor import show
from ceilvo.daemon.editing.joining import both_times, matches_by_id
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import keep_copy, open_map
from ceilvo.daemon.odometry.rigid import rigid_motion
from ceilvo.daemon.refinement.calibration_field import CalibrationPrior
from ceilvo.daemon.refinement.sessions import refined_map
from ceilvo.daemon.refinement.survey import Floor
from ceilvo.errors import CeilvoError, one_line
from ceilvo.types import Ints

_FEWEST_MARKS = 2


@dataclass(frozen=True)
class Refinement:
    """What was asked for.

    Attributes:
        eyes: which calibration saw which sessions.
        tapes, marks: as typed, with their standard deviations.
        on_round: told the round and the cost.
    """

    eyes: Eyes
    tapes: Sequence[TypedTape] = ()
    marks: Sequence[TypedMark] = ()
    tape_sigma_m: float = 2e-3
    mark_sigma_m: float = 5e-3
    on_round: Callable[[int, float], None] = lambda _round, _cost: None


def refine_all(contents: Sequence[MapContent], asked: Refinement) -> Outcome:
    """Floors refined together: they share the calibrations.

    Raises:
        CeilvoError: there is nothing to refine, or it cannot be done.
    """
    names = [c.floor for c in contents]
    start = [_laid_on_marks(c, names, asked.marks) for c in contents]
    floors, calibrations = asked.eyes.floors(start)
    anchors = measured(
        names, asked.eyes.floors(contents)[0], asked.tapes, asked.marks, asked.tape_sigma_m, asked.mark_sigma_m
    )
    try:
        done = refined_map(floors, calibrations, CalibrationPrior(), anchors, asked.on_round)
    except ValueError as e:
        raise CeilvoError(f"nothing to refine: {e}; drive once more through the building") from e
    after = [_content(c, f, now) for c, f, now in zip(start, done.floors, done.renamed, strict=True)]
    return Outcome(tuple(contents), tuple(after), asked.eyes, done)


def _laid_on_marks(content: MapContent, names: Sequence[str], marks: Sequence[TypedMark]) -> MapContent:
    """The map turned and shifted to where its marks should be, so that what is left is small."""
    own = [m.mark for m in marks if names[floor_of(names, m.floor, "--mark", m.text)] == content.floor]
    if not own:
        return content
    if len(own) < _FEWEST_MARKS:
        raise CeilvoError(f"--mark: given once for floor {content.floor!r}, expected twice or more: one does not turn")
    here, there = np.array([m.here_m for m in own]), np.array([m.there_m for m in own])
    return moved(content, rigid_motion(here, there))


def _content(before: MapContent, floor: Floor, now: Ints) -> MapContent:
    """A floor's map with what was refined of it; now: (L,) the id that each landmark has."""
    at = np.searchsorted(floor.landmarks.ids, now)
    order = np.argsort(at, kind="stable")
    first = np.flatnonzero(np.diff(at[order], prepend=-1))
    seen_s = before.seen_s[order[first]].copy()
    for k in np.flatnonzero(np.diff(at[order], prepend=-1) == 0):
        seen_s[at[order[k]]] = both_times(seen_s[at[order[k]]][None], before.seen_s[order[k]][None])[0]
    sessions = {s.session: s for s in floor.sessions}
    key_poses = tuple(sessions.get(k.session, k) for k in before.key_poses)
    return replace(before, landmarks=floor.landmarks, seen_s=seen_s, axis_rad=floor.axis_rad, key_poses=key_poses)


def refine(options: argparse.Namespace) -> int:
    """The command; 0, or an error."""
    path: Path = options.file
    if not sources.is_database(path):
        raise CeilvoError(f"{path}: no database of maps, so it has no key poses to refine from; 'ceilvod map build' it")
    found = _read(path, options.floor)
    asked = Refinement(
        Eyes.read(options.calibration, options.config),
        options.tape,
        options.mark,
        1e-3 * options.tape_sigma,
        1e-3 * options.mark_sigma,
        progress(),
    )
    new = asked.eyes.targets(options.write_calibration)
    done = refine_all([c for c, _ in found], asked)
    for line in told(done):
        print(line)
    what = one_line(" ".join(["refine", *(f"--tape {t.text}" for t in asked.tapes)]))
    for before, after in zip(done.before, done.after, strict=True):
        if options.png is not None:
            picture = options.png
            if len(done.after) > 1:
                picture = picture.with_stem(f"{picture.stem}-{after.floor}")
            show(picture, before, after, matches_by_id(before.landmarks, after.landmarks), what)
    if options.dry_run:
        print(f"{path}: would be refined; nothing was written")
        return 0
    with open_map(path, done.after[0].floor) as db:
        keep_copy(db)
        db.edit_floors({a.floor: (a, h) for a, (_, h) in zip(done.after, found, strict=True)}, what)
    print(f"{path}: refined; 'ceilvod map undo {path}' takes it back, floor by floor where there are several")
    for line in write_calibrations(done, new):
        print(line)
    return 0


def _read(path: Path, floor: str | None) -> list[tuple[MapContent, str]]:
    with open_map(path, floor or "") as db:
        names = db.floors if floor is None else (floor,)
    return [sources.read_with_hash(path, name) for name in names]


def progress() -> Callable[[int, float], None]:
    """On a terminal the rounds."""
    if not sys.stderr.isatty():
        return lambda _round, _cost: None
    return lambda k, cost: print(f"\rround {k}, cost {cost:.0f} ", end="", file=sys.stderr, flush=True)
