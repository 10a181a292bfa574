"""What the suspicions do to the state and the pose, on a recorded lap."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from golden_drives import RATE_HZ, Drive, load

from ceilvo import se2
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.snapshot import freeze, restore, snapshot_json
from ceilvo.types import Crossings, Displacement, Estimate, State, WheelMotion

FAULT = 100
"""Frame from which something is wrong: the robot drives, 0.5 m/s."""


@pytest.fixture(scope="module")
def lap() -> Drive:
    return load("lap", "joint")


@pytest.fixture(scope="module")
def truth(lap: Drive) -> np.ndarray:
    """Poses of the run without faults, which are right to millimetres."""
    return np.array([e.pose for e in run(lap, lambda k: lap.crossings[k], lambda k: lap.wheels[k])[1]])


def run(
    lap: Drive, picture: Callable[[int], Crossings | None], wheels: Callable[[int], WheelMotion | None]
) -> tuple[Pipeline, list[Estimate]]:
    pipeline = Pipeline(lap.calibration, lap.config, np.random.default_rng(1))
    stamps = [10**9 + round(k * 1e9 / RATE_HZ) for k in range(len(lap.crossings))]
    return pipeline, [pipeline.step_crossings(t, picture(k), wheels(k)) for k, t in enumerate(stamps)]


def wrong(estimates: list[Estimate], truth: np.ndarray) -> list[int]:
    """Frames whose pose is said to be usable, and is not."""
    off = [se2.between(t, e.pose) for t, e in zip(truth, estimates, strict=True)]
    return [
        k
        for k, (o, e) in enumerate(zip(off, estimates, strict=True))
        if e.state in (State.TRACKING, State.DEGRADED) and (np.hypot(*o[:2]) > 0.3 or abs(o[2]) > np.radians(5.0))
    ]


def test_a_lap_without_faults_is_not_suspected(lap: Drive) -> None:
    pipeline, estimates = run(lap, lambda k: lap.crossings[k], lambda k: lap.wheels[k])
    assert not any(pipeline.checks.counters.values())
    assert estimates[-1].state is State.TRACKING


@pytest.mark.parametrize("size", [1, 2, 4])
@pytest.mark.parametrize("with_wheels", [True, False])
def test_old_pictures_are_dead_reckoned_and_named(lap: Drive, truth: np.ndarray, size: int, with_wheels: bool) -> None:
    def picture(k: int) -> Crossings:
        return lap.crossings[k if k < FAULT else FAULT - size + (k - FAULT) % size]

    pipeline, estimates = run(lap, picture, lambda k: lap.wheels[k] if with_wheels or k < FAULT else None)
    kind = Kind.FROZEN if size == 1 else Kind.REPEATS
    assert pipeline.checks.counters[kind.value] == 1
    assert wrong(estimates, truth) == []
    assert estimates[FAULT + 5].state is State.DEAD_RECKONING
    assert ("frozen" if size == 1 else "old buffers") in estimates[FAULT + 5].reason


def test_a_picture_that_stands_while_wheels_turn_says_nothing_of_the_place(lap: Drive, truth: np.ndarray) -> None:
    """Frozen, with noise of its own: every frame of it was weighed as if the robot saw the same from where it went."""

    def picture(k: int) -> Crossings:
        at = lap.crossings[min(k, FAULT)]
        noise_m = np.random.default_rng([3, k]).normal(0.0, 5e-5, at.xy_base_m.shape)
        return replace(at, xy_base_m=at.xy_base_m + noise_m) if k > FAULT else at

    beliefs = []
    for frames in (FAULT + 30, FAULT + 60):
        pipeline, estimates = run(replace(lap, crossings=lap.crossings[:frames]), picture, lambda k: lap.wheels[k])
        assert wrong(estimates, truth[:frames]) == []
        assert pipeline.checks.counters[Kind.STANDS.value] == 1
        pending = pipeline.relocaliser.state.pending
        assert pending is not None and pending.reach_m < 2.0 * np.hypot(*(truth[frames - 1] - truth[FAULT])[:2])
        beliefs.append(pipeline.relocaliser.state.belief)
    for name in ("places", "log_weight", "seen", "spot"):
        assert np.array_equal(getattr(beliefs[0], name), getattr(beliefs[1], name))
    assert beliefs[0].unknown == beliefs[1].unknown


def test_a_picture_that_stands_is_no_better_while_the_map_has_only_begun(lap: Drive, truth: np.ndarray) -> None:
    """Doubts of the place are not kept then: what looked worse was TRACKING again."""
    since = 12

    def picture(k: int) -> Crossings:
        at = lap.crossings[min(k, since)]
        noise_m = np.random.default_rng([4, k]).normal(0.0, 5e-5, at.xy_base_m.shape)
        return replace(at, xy_base_m=at.xy_base_m + noise_m) if k > since else at

    pipeline, estimates = run(replace(lap, crossings=lap.crossings[: since + 90]), picture, lambda k: lap.wheels[k])
    assert pipeline.relocaliser.state.pending is None
    assert np.hypot(*(truth[since + 89] - truth[since])[:2]) > 0.5
    assert wrong(estimates, truth[: since + 90]) == []
    assert estimates[-1].state is State.RELOCALISING
    assert "while the picture stood" in estimates[-1].reason


def test_reversed_wheels_are_left_out_and_vision_goes_on(lap: Drive, truth: np.ndarray) -> None:
    def wheels(k: int) -> WheelMotion:
        return WheelMotion(Displacement(lap.wheels[k].prev_from_curr * [-1.0, -1.0, 1.0]), lap.wheels[k].cov)

    _, estimates = run(lap, lambda k: lap.crossings[k], wheels)
    assert wrong(estimates, truth) == []
    assert np.hypot(*(estimates[-1].pose - truth[-1])[:2]) < 0.02
    assert estimates[-1].state is State.DEGRADED
    assert "wheels are not used" in estimates[-1].reason


def test_a_robot_that_is_lifted_in_the_dark_is_in_doubt(lap: Drive) -> None:
    """It had stood for a while, and is put down again on the same place: nobody can know at once."""
    still = WheelMotion(Displacement(np.zeros(3)), np.diag([1e-9, 1e-9, 1e-11]))
    seen = [replace(c, xy_base_m=c.xy_base_m.copy()) for c in lap.crossings]
    rng = np.random.default_rng(2)

    def picture(k: int) -> Crossings | None:
        if FAULT + 5 <= k < FAULT + 10:
            return None
        at = seen[min(k, FAULT)]
        return at if k <= FAULT else replace(at, xy_base_m=at.xy_base_m + rng.normal(0.0, 5e-5, at.xy_base_m.shape))

    _, estimates = run(lap, picture, lambda k: lap.wheels[k] if k <= FAULT else still)
    assert estimates[FAULT + 4].state is State.TRACKING
    assert estimates[FAULT + 10].state is State.RELOCALISING


def test_a_snapshot_in_a_fault_goes_on_as_the_original(lap: Drive) -> None:
    def picture(k: int) -> Crossings:
        return lap.crossings[k if k < FAULT else FAULT - 2 + k % 2]

    pipeline, _ = run(replace(lap, crossings=lap.crossings[: FAULT + 3]), picture, lambda k: lap.wheels[k])
    again = Pipeline(lap.calibration, lap.config, np.random.default_rng(2))
    restore(again, json.loads(json.dumps(snapshot_json(freeze(pipeline), "joint"))))
    assert again.checks.counters == pipeline.checks.counters
    for k in range(FAULT + 3, FAULT + 6):
        stamp_ns = 10**9 + round(k * 1e9 / RATE_HZ)
        one, other = (p.step_crossings(stamp_ns, picture(k), lap.wheels[k]) for p in (pipeline, again))
        assert one.reason == other.reason
        assert np.array_equal(one.pose, other.pose)
    assert again.checks.counters == pipeline.checks.counters
