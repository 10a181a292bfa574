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
from ceilvo.daemon.app.estimator import Estimator
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.base.mock_base import MockBase
from ceilvo.drivers.camera.capture import CaptureEvent, CaptureLoop
from ceilvo.drivers.camera.mock_camera import MockCamera, moving_square
from ceilvo.drivers.rate_limit import QuietLog, TokenBucket
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Estimate, FilterHealth, Frame, Motion, State

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
