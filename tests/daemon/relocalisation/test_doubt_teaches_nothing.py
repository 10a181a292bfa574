"""While the place is in doubt views correct the pose, and no landmark of the map learns of it; the submap's do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.bench.place.case import drive_in, load_known
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.config import Config, Filter
from ceilvo.daemon.relocalisation.relocaliser_state import RelocaliserState
from ceilvo.json_values import MAX_ID
from ceilvo.types import Array

SEED = 6
COLUMNS = ("xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")


def rows(drive: Drive, below_id: int = MAX_ID) -> dict[int, list[object]]:
    """Of the landmarks, by id, with the evidence that they are gone."""
    landmarks, joint = drive.pipeline.filter.landmarks(), drive.pipeline.filter.state.joint
    doubt = dict(zip(joint.ids.tolist(), joint.doubt.tolist(), strict=True))
    return {
        i: [doubt[i], *(getattr(landmarks, name)[k].tolist() for name in COLUMNS)]
        for k, i in enumerate(landmarks.ids.tolist())
        if i < below_id
    }


def off_m(drive: Drive) -> float:
    assert drive.estimate is not None
    return float(np.hypot(*(np.asarray(drive.estimate.pose) - drive.pose)[:2]))


def hall(method: str = "joint") -> Drive:
    """A robot in a hall of 20 m with few lamps, without wheels."""
    rng = np.random.default_rng(SEED)
    drive = drive_in(make_world(WorldSpec("20", 0.6, "sparse", SEED)), rng, False, 10.0, True, 0.8)
    drive.config = Config(filter=Filter(method=method))
    drive.begin_anew()
    return drive


def on_a_map(off: Array, method: str = "joint") -> Drive:
    """One that begins on the map of it, with a stored pose that is off by (3,)."""
    drive, rng = hall(method), np.random.default_rng(SEED)
    world = make_world(WorldSpec("20", 0.6, "sparse", SEED))
    load_known(drive, world, rng, drive.pose + off)
    return drive


@pytest.mark.parametrize("method", ["joint", "ukf"])
def test_the_map_stays_as_it_was_stored_and_the_pose_is_put_right(method: str) -> None:
    """Two such views moved 30 landmarks, and counted them as seen."""
    drive = on_a_map(np.array([0.03, -0.02, 0.005]), method)
    before, updates, doubted = rows(drive), drive.pipeline.filter.counters()["observations"], 0
    assert len(before) > 1000
    for _ in range(200):
        drive.tick()
        if drive.pipeline.relocaliser.sure:
            break
        doubted += 1
        assert rows(drive) == before
    seen = drive.pipeline.filter.counters()["observations"] - updates
    print(
        f"seed {SEED}, {method}: in doubt for {doubted} views, {seen} features told where it is to {off_m(drive):.4f} m"
    )
    assert doubted >= 2
    assert seen > 20
    assert off_m(drive) < 0.005
    drive.go(2)
    assert rows(drive) != before  # sure again, it learns


def test_a_robot_in_doubt_does_not_lose_its_way_on_the_map() -> None:
    drive = on_a_map(np.zeros(3))
    assert drive.settle(60.0)
    before, most, doubted = rows(drive), 0.0, 0
    for k in range(60):
        if drive.pipeline.relocaliser.sure:
            before = rows(drive)
        if k % 10 == 0:
            drive.pipeline.relocaliser.suspect("said by the test", 3.0)
        drive.tick()
        if not drive.pipeline.relocaliser.sure:
            assert rows(drive, drive.pipeline.relocaliser.state.submap_from or MAX_ID) == before
            doubted, most = doubted + 1, max(most, off_m(drive))
    print(f"seed {SEED}: in doubt for {doubted} of 60 views, off by {most:.4f} m at most")
    assert doubted > 40
    assert most < 0.01


def test_what_it_begins_itself_in_doubt_is_learnt() -> None:
    """25 s of mapping, 2 s of darkness, and on over new ground: only landmarks from the submap's first id on."""
    drive = hall()
    drive.at_truth()
    drive.go(25)
    drive.conditions.dark = True
    drive.go(2)
    drive.conditions.dark = False
    before = rows(drive)
    drive.go(10)
    first_id = drive.pipeline.relocaliser.state.submap_from
    assert first_id is not None
    assert rows(drive, first_id) == before
    own = {i: row for i, row in rows(drive).items() if i >= first_id}
    drive.go(5)
    assert drive.pipeline.relocaliser.state.submap_from == first_id
    later = rows(drive)
    assert {i: row for i, row in later.items() if i < first_id} == before
    learnt = [i for i, row in own.items() if i in later and later[i] != row]
    print(f"seed {SEED}: {len(before)} held, {len(later) - len(before)} own, {len(learnt)} learnt")
    assert len(own) > 30
    assert len(learnt) > 5


def test_what_was_not_yet_a_landmark_when_the_doubt_began_is_of_neither_side() -> None:
    drive = hall()
    drive.at_truth()
    drive.go(15)
    joint = drive.pipeline.filter.state.joint
    newborn = joint.ids[joint.size :]
    assert len(newborn)
    state = RelocaliserState()
    state.open_submap(drive.pipeline.filter)
    joint = drive.pipeline.filter.state.joint
    assert len(joint) == joint.size
    assert state.submap_from == joint.next_id > max(np.max(newborn), np.max(joint.ids))


@pytest.mark.parametrize(("reason", "submap", "least"), [("", None, 0), ("moved", None, MAX_ID), ("moved", 7, 7)])
def test_what_may_learn(reason: str, submap: int | None, least: int) -> None:
    assert replace(RelocaliserState(), reason=reason, submap_from=submap).learnt_from == least
