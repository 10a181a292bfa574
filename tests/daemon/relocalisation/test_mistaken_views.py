"""A view whose lines were mistaken gives odometry a small doubt: it does not count again against the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.bench.place.case import SETTLE_S, drive_in, load_known
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.daemon.odometry.dead_reckoning import Track
from ceilvo.daemon.relocalisation.doubts import UNLIKELY
from ceilvo.types import State

DOUBT = 0.3 * UNLIKELY
DT_S = 0.1


def doubted_once(drive: Drive, doubt: float) -> list[float]:
    """The next good motion has this doubt; returns after how many metres it was weighed, once it was."""
    relocaliser, weighed = drive.pipeline.relocaliser, [0.0]
    plain, todo, way = relocaliser.travelled, [doubt], [0.0]

    def travelled(track: Track, crossings: int) -> None:
        if todo and track.final is not None:
            track = replace(track, final=replace(track.final, doubt=todo.pop()))
            weighed.clear()
        way[0] += track.moved_m
        plain(track, crossings)

    def observed(*args: object) -> bool:
        pending = relocaliser.state.pending is not None
        out = weigh(*args)
        if pending and relocaliser.state.pending is None:
            weighed.append(way[0])
        return bool(out)

    weigh = relocaliser._weigh
    relocaliser.travelled = travelled  # type: ignore[method-assign]
    relocaliser._weigh = observed  # type: ignore[method-assign, assignment]
    way[0] = 0.0
    return weighed


def settled(seed: int) -> Drive:
    world = make_world(WorldSpec("5", 0.6, "sparse", 1000 * seed))
    drive = drive_in(world, np.random.default_rng(seed), True, 1.0 / DT_S, True, 0.5)
    load_known(drive, world, drive.rng)
    assert drive.settle(SETTLE_S)
    return drive


@pytest.mark.parametrize("seed", [41, 42])
def test_a_small_doubt_is_weighed_from_another_spot_and_the_pose_is_degraded_until_then(seed: int) -> None:
    drive = settled(seed)
    weighed = doubted_once(drive, DOUBT)
    states, way = [], 0.0
    while way < 0.6:
        estimate = drive.tick()
        assert estimate is not None
        states.append(estimate.state)
        way += float(np.hypot(*estimate.motion.prev_from_curr[:2]))
    print(f"seed {seed}: {[s.name for s in states]}, weighed after {weighed}")
    assert states[0] is State.DEGRADED and State.RELOCALISING not in states
    assert len(weighed) == 1 and 0.2 < weighed[0] < 0.45
    assert states[-1] in (State.TRACKING, State.DEGRADED)


@pytest.mark.parametrize("seed", [41])
def test_a_large_doubt_is_weighed_at_once(seed: int) -> None:
    drive = settled(seed)
    weighed = doubted_once(drive, 20.0 * UNLIKELY)
    estimate = drive.tick()
    assert estimate is not None and estimate.state is not State.TRACKING
    for _ in range(2):
        drive.tick()
    assert len(weighed) == 1 and weighed[0] < 0.15


def test_a_large_doubt_after_a_small_one_does_not_wait_for_another_spot() -> None:
    """A robot that was lifted and stands does not come to one."""
    drive = settled(43)
    doubted_once(drive, DOUBT)
    drive.tick()
    assert drive.pipeline.relocaliser.state.pending is not None, "the small one waits"
    weighed = doubted_once(drive, 20.0 * UNLIKELY)
    for _ in range(2):
        drive.tick()
    assert len(weighed) == 1 and weighed[0] < 0.15
