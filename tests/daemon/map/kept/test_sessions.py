"""Drives add to a map: what a later one does not see stays, what it contradicts gives way, and the map says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ceilvo.bench.place.case import drive_in
from ceilvo.bench.place.ceiling.truth import Features
from ceilvo.bench.place.ceiling.worlds import World, WorldSpec, make_world
from ceilvo.bench.place.faults.changes import renovated
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.bench.place.robot.sights import CrossingSight
from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.map.database.content import Session
from ceilvo.daemon.map.database.database import MapDatabase
from ceilvo.daemon.map.kept.store import MAP_NAME, Store
from ceilvo.types import Landmarks

SEED = 8
ROOM = WorldSpec("5", 0.6, "raster", SEED)
SAVES, BETWEEN_S = 3, 14.0
NEAR_M = 0.05
SHARE = 0.25
"""Of the room that is renovated."""


def drive_and_save(drive: Drive, folder: Path, session: str) -> Landmarks:
    """A run of the daemon on what the folder holds."""
    assert isinstance(drive.camera, CrossingSight)
    store = Store(folder, session=session)
    found = store.load()
    if found is None:
        drive.at_truth()
    else:
        drive.begin_anew()
        drive.estimator.load_map(found.map, found.state)
    refused = 0
    for _ in range(SAVES):
        drive.go(BETWEEN_S)
        assert drive.estimate is not None
        before, refused = refused, drive.estimator.refused()
        assert store.save(*drive.estimator.map(), drive.estimate, refused=refused - before), store.error
    store.close()
    landmarks, axis_rad = drive.estimator.map()
    assert axis_rad is not None
    turns = quarter_turns(axis_rad, drive.camera.eye.features.axis_rad)  # the map names types by its own axes
    return replace(landmarks, crossing_type=turned_type(landmarks.crossing_type, turns))


def sessions_in(folder: Path) -> tuple[Session, ...]:
    with MapDatabase(folder / MAP_NAME) as db:
        return db.content().sessions


def true_share(landmarks: Landmarks, features: Features) -> float:
    """Of the landmarks, those on a crossing of their type."""
    off = np.hypot(*(landmarks.xy_map_m[:, None] - features.xy_map_m).transpose(2, 0, 1))
    off[landmarks.crossing_type[:, None] != features.crossing_type] = np.inf
    return float(np.mean(off.min(axis=1) < NEAR_M))


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, World, Features, list[Landmarks]]:
    """One that learns a room, one that sees it again, and one after a quarter of its ceiling was made anew."""
    folder, world = tmp_path_factory.mktemp("state"), make_world(ROOM)
    drive = drive_in(world, np.random.default_rng(SEED), True, 10.0, False, 0.5)
    maps = [drive_and_save(drive, folder, name) for name in ("monday", "tuesday")]
    assert isinstance(drive.camera, CrossingSight)
    changed = renovated(world, SHARE, np.random.default_rng(SEED))
    drive.camera.use(changed)
    maps.append(drive_and_save(drive, folder, "wednesday"))
    return folder, world, changed, maps


def test_a_second_drive_adds_little_and_keeps_what_there_was(
    drives: tuple[Path, World, Features, list[Landmarks]],
) -> None:
    folder, _, _, (first, second, _) = drives
    monday, tuesday, _ = sessions_in(folder)
    assert (monday.name, monday.saves, tuesday.saves) == ("monday", SAVES, SAVES)
    assert monday.added - monday.faded == len(first) > 100
    assert len(first) + tuesday.added - tuesday.faded == len(second)
    kept = np.isin(first.ids, second.ids)
    assert np.mean(kept) > 0.95 and tuesday.faded < 0.05 * len(first), "nothing was wiped"


def test_what_was_renovated_fades_and_comes_anew_and_the_counts_say_so(
    drives: tuple[Path, World, Features, list[Landmarks]],
) -> None:
    folder, world, changed, (_, before, after) = drives
    wednesday = sessions_in(folder)[2]
    was, is_now, then = true_share(before, world.features), true_share(before, changed), true_share(after, changed)
    gone = was - is_now
    assert gone > 0.05, "the ceiling is another one"
    assert wednesday.faded > 0.5 * gone * len(before), "the latest views decide, however often it was seen before"
    assert wednesday.added > 10
    assert wednesday.refused > 0, "what was not seen again"
    assert then > is_now + 0.5 * gone, f"true: {was:.2f}, on the other day {is_now:.2f}, after it {then:.2f}"
    lasting = world.features.axis_rad == changed.axis_rad
    assert lasting and len(np.intersect1d(before.ids, after.ids)) > 0.7 * len(before), "the rest of the map stays"
    with MapDatabase(folder / MAP_NAME) as db:
        stored = db.load()
    assert stored is not None and np.array_equal(stored.landmarks.ids, np.sort(after.ids))
