"""The parts that make faults harmless, one by one and without time."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from patience import PATIENCE_S

from ceilvo import config
from ceilvo.config import Config
from ceilvo.crossing_types import turned_type
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.relocalisation.place_search import ReachableRegion, search_places
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.base.mock_base import MockBase
from ceilvo.drivers.camera.capture import CaptureEvent, CaptureLoop
from ceilvo.drivers.camera.mock_camera import MockCamera, moving_square
from ceilvo.drivers.rate_limit import QuietLog, TokenBucket
from ceilvo.se2 import inverse, transform
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Estimate, FilterHealth, Frame, Landmarks, Motion, Observations, State

SEED = 6


class Clock:
    def __init__(self, now_ns: int = 10**10) -> None:
        self.now_ns = now_ns

    def __call__(self) -> int:
        return self.now_ns

    def wait(self, seconds: float) -> None:
        self.now_ns += round(1e9 * seconds)


# --- rates


def test_a_bucket_lets_a_burst_through_and_then_its_rate() -> None:
    clock = Clock()
    bucket = TokenBucket(5.0, 3, clock)
    assert [bucket.take() for _ in range(5)] == [True] * 3 + [False] * 2
    clock.wait(0.2)
    assert [bucket.take() for _ in range(2)] == [True, False]
    clock.wait(3600.0)
    assert [bucket.take() for _ in range(4)] == [True] * 3 + [False]


def test_a_quiet_log_says_how_much_it_left_out(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    quiet = QuietLog(logging.getLogger("x"), 1.0, 2, clock)
    for _ in range(10):
        quiet.warning("refused")
    clock.wait(1.0)
    quiet.warning("refused")
    assert [r.getMessage() for r in caplog.records] == [
        "refused",
        "refused",
        "refused (8 more like this were not logged)",
    ]


# --- a camera that repeats itself


def captured(picture: Callable[[int, int, int], np.ndarray], count: int, **settings: bool) -> tuple[int, int]:
    """Good frames and repeats of `count` frames of a camera with that picture."""
    import threading

    done = threading.Event()
    taken = 0

    def wait(_: float) -> None:
        nonlocal taken
        taken += 1
        if taken > count:
            done.set()
            threading.Event().wait(0.01)

    camera = MockCamera(wait=wait, picture=picture)
    events: list[CaptureEvent] = []
    loop = CaptureLoop(camera, config.Camera(**settings), lambda: 0, events.append)  # type: ignore[arg-type]
    loop.start()
    assert done.wait(PATIENCE_S)
    assert loop.stop(PATIENCE_S)
    return loop.counters().frames, loop.counters().repeats


def test_a_frozen_picture_is_no_frame() -> None:
    frames, repeats = captured(lambda n, w, h: moving_square(min(n, 4), w, h), 20)
    assert frames == 5
    assert repeats >= 15


@pytest.mark.parametrize("buffers", [2, 4, 8])
def test_a_driver_that_goes_round_old_buffers_is_no_camera(buffers: int) -> None:
    def ring(n: int, w: int, h: int) -> np.ndarray:
        return moving_square(n if n < 10 else 10 - buffers + (n - 10) % buffers, w, h)

    frames, repeats = captured(ring, 40)
    assert frames == 10
    assert repeats >= 25


def test_a_picture_that_comes_again_later_is_new() -> None:
    """Nine pictures in turn: a robot that goes in a small circle may well be where it was."""
    assert captured(lambda n, w, h: moving_square(n % 9, w, h), 40)[1] == 0


def test_a_picture_that_changes_by_one_bit_is_new() -> None:
    def noisy(n: int, w: int, h: int) -> np.ndarray:
        image = moving_square(0, w, h)
        image[n % h, n % w] ^= 1
        return image

    assert captured(noisy, 20)[1] == 0


def test_darkness_is_not_a_frozen_camera() -> None:
    assert captured(lambda n, w, h: np.zeros((h, w), np.uint8), 20)[1] == 0


def test_repeats_may_be_allowed() -> None:
    assert captured(lambda n, w, h: moving_square(0, w, h), 20, refuse_repeats=False)[1] == 0


# --- stamps that run at another rate than the clock


@pytest.mark.parametrize("live", [True, False])
def test_frames_are_stamped_on_arrival_once_their_stamps_fall_behind(live: bool) -> None:
    """A recording that is played slowly is no fault."""
    clock, calibration = Clock(), replace(simulated_calibration(), camera_id="")
    estimator = Estimator(Pipeline(calibration, Config(), np.random.default_rng(SEED)), clock)
    gray = np.zeros((calibration.camera.height_px, calibration.camera.width_px), np.uint8)
    begin_ns, off_s = clock(), 0.0
    for k in range(60):
        clock.wait(0.1)
        told_ns = begin_ns + round(0.8 * (clock() - begin_ns)) - 20_000_000
        estimate = estimator.frame(Frame(k, told_ns, gray), live)
        assert estimate is not None
        off_s = 1e-9 * (clock() - estimate.stamp_ns)
    assert (off_s < 0.2) == live
    assert estimator.suspicions()["stamp_rate"] == live
    assert ("0.80 times the computer's clock" in estimator.stamp_fault) == live


# --- a slow camera that stalls


def test_frames_of_a_slow_camera_are_not_late_after_a_stall() -> None:
    """Its frames are 0.4 s old when they come: longer than the estimator waits between two looks at a silent one."""
    clock, calibration = Clock(), replace(simulated_calibration(), camera_id="")
    estimator = Estimator(Pipeline(calibration, Config(), np.random.default_rng(SEED)), clock)
    gray = np.zeros((calibration.camera.height_px, calibration.camera.width_px), np.uint8)

    def frame() -> Estimate | None:
        return estimator.frame(Frame(0, clock.now_ns - 400_000_000, gray))

    for _ in range(5):
        clock.wait(0.1)
        assert frame() is not None
    for _ in range(20):
        clock.wait(0.1)
        last = estimator.silence("the camera gives no frames")
        assert last is not None
        assert last.state is not State.TRACKING
    late = estimator.late
    for _ in range(5):
        clock.wait(0.1)
        assert frame() is not None
    assert estimator.late == late


# --- an estimator that hangs


def estimate(clock: Clock, state: State) -> Estimate:
    return Estimate(
        seq=1,
        stamp_ns=clock.now_ns,
        pose=np.zeros(3),
        cov=1e-4 * np.eye(3),
        odom=np.zeros(3),
        twist=np.zeros(3),
        state=state,
        quality=0.9,
        reason="",
        motion=Motion(np.zeros(3), np.eye(3), 9, 0.0),
        health=FilterHealth(0, 0.0, 0, 0.0, 0.0, 0),
        crossings=0,
        landmarks=0,
    )


@pytest.mark.parametrize("state", [State.TRACKING, State.DEGRADED, State.LOST])
def test_a_stale_estimate_is_not_told_as_good(state: State) -> None:
    clock = Clock()
    link = BaseLink(config.Base(stale_s=0.5), MockBase(), clock)
    link.submit(estimate(clock, state))
    clock.wait(0.4)
    assert link._telegram().state is state
    clock.wait(0.2)
    told = link._telegram()
    assert told.state is (State.LOST if state is State.LOST else State.DEAD_RECKONING)
    assert abs(told.age_s - 0.6) < 1e-6
    assert state is State.LOST or told.quality == 0.0


# --- looking for the place


def ceiling(rng: np.random.Generator) -> Landmarks:
    """A grid of tiles with some of another kind, so that places differ."""
    i, j = np.meshgrid(np.arange(12), np.arange(12))
    xy = 0.6 * np.column_stack([i.ravel(), j.ravel()]).astype(np.float64)
    kind = np.where(rng.random(len(xy)) < 0.25, 8, 4)
    n = len(xy)
    return Landmarks(np.arange(n), xy, np.tile(1e-4 * np.eye(2), (n, 1, 1)), kind, np.full(n, 5))


@pytest.mark.parametrize("seed", range(5))
def test_the_place_that_explains_a_view_is_found_whatever_was_believed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    landmarks = ceiling(rng)
    pose = np.array([*rng.uniform(2.5, 4.0, 2), rng.uniform(-np.pi, np.pi)])
    near = np.hypot(*(landmarks.xy_map_m - pose[:2]).T) < 1.8
    c, s = np.cos(pose[2]), np.sin(pose[2])
    seen = (landmarks.xy_map_m[near] - pose[:2]) @ np.array([[c, -s], [s, c]]) + rng.normal(0, 0.005, (near.sum(), 2))
    turn = int(rng.integers(4))  # the view knows its heading modulo a quarter turn, and names its kinds by it
    kind = turned_type(landmarks.crossing_type[near], (4 - turn) % 4)
    heading = float(pose[2]) + 0.5 * np.pi * turn
    n = int(near.sum())
    view = Observations(seen, np.full((n, 2), 1e-4), kind, np.full(n, -1), heading, 1e-6, 0.0)
    place = search_places(landmarks, view, np.array([0.0, 0.0, 0.0]))
    assert place is not None
    assert place.explained >= 0.9 * n
    assert np.hypot(*(place.pose - pose)[:2]) < 0.2
    assert abs(np.angle(np.exp(1j * (place.pose[2] - pose[2])))) < 1e-6
    there = search_places(landmarks, view, pose)
    assert there is not None
    assert there.here == there.explained


def tiles(width: int, height: int) -> Landmarks:
    """Landmarks 0.6 m apart, every 4th by 3rd a lamp's: the ceiling looks the same 2.4 and 1.8 m further."""
    i, j = (a.ravel() for a in np.meshgrid(np.arange(width), np.arange(height)))
    kind = np.where((i % 4 == 0) & (j % 3 == 0), 2, 4)
    n = len(kind)
    return Landmarks(np.arange(n), 0.6 * np.column_stack([i, j]), np.tile(np.eye(2) * 1e-6, (n, 1, 1)), kind, kind)


def seen_at(whole: Landmarks, pose: Array) -> Observations:
    near = np.hypot(*(whole.xy_map_m - pose[:2]).T) < 1.5
    n = int(near.sum())
    xy = transform(inverse(pose), whole.xy_map_m[near])
    return Observations(xy, np.full((n, 2), 1e-4), whole.crossing_type[near], np.full(n, -1), float(pose[2]), 1e-6, 0.0)


@pytest.mark.parametrize("reach_m", [0.5, 1.0])
def test_ground_that_is_not_mapped_is_not_taken_for_a_place_like_it(reach_m: float) -> None:
    """The robot drove off the map; what it sees there is all on the map too, 2.4 m back."""
    whole, pose = tiles(20, 10), np.array([8.6, 2.9, 0.0])
    mapped = whole.xy_map_m[:, 0] < 7.5
    part = Landmarks(
        *(getattr(whole, name)[mapped] for name in ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings"))
    )
    view = seen_at(whole, pose)
    anywhere = search_places(part, view, pose)
    assert anywhere is not None and anywhere.explained == len(view)
    place = search_places(part, view, pose, ReachableRegion(pose, reach_m))
    assert place is not None and place.explained < 0.8 * len(view)
    assert place.allows(place.pose) and not place.allows(anywhere.pose)


def test_a_robot_that_was_carried_off_mapped_ground_is_found_anywhere() -> None:
    whole = tiles(20, 10)
    pose, believed = np.array([8.6, 2.9, 0.0]), np.array([7.6, 2.2, 0.1])
    view = seen_at(whole, pose)
    place = search_places(whole, view, believed, ReachableRegion(believed, 0.5))
    assert place is not None and place.explained == len(view) > place.here
    assert place.allows(pose)


def test_without_a_map_there_is_no_place() -> None:
    none = Landmarks(*(np.zeros(s) for s in (0, (0, 2), (0, 2, 2), 0, 0)))  # type: ignore[arg-type]
    view = Observations(np.ones((3, 2)), np.ones((3, 2)), np.full(3, 4), np.full(3, -1), 0.0, 1.0, 0.0)
    assert search_places(none, view, np.zeros(3)) is None
