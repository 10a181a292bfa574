"""Wheels under a standing picture, a picture over standing wheels, blindness on the spot; and drives without."""

import math

import numpy as np
import pytest
from told_drives import DRIVING, ahead, blind, paths_of, seen, still, told

from ceilvo.bench.cross_checks.drives import DriveSpec
from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.daemon.odometry.cross_checks.standing import CARRY_MPS, Standing
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion
from ceilvo.types import Motion, WheelMotion

LATE_S = 0.2
RATE_HZ = 30.0
NOTHING = np.zeros(3)


class Rig:
    """A check with its paths, fed frame by frame."""

    def __init__(self) -> None:
        self.check, self.paths, self.rng = Standing(0.15), Paths(), np.random.default_rng(4)

    def frame(self, motion: Motion, wheels: WheelMotion | None, elapsed_s: float = 1.0 / RATE_HZ) -> list[Suspicion]:
        self.paths.add(motion, wheels, elapsed_s)
        return self.check.step(self.paths, LATE_S)

    def drive(self, frames: int, step_m: float = 0.01) -> list[Suspicion]:
        return [s for _ in range(frames) for s in self.frame(self.seen(step_m), ahead(step_m))]

    def seen(self, step_m: float = 0.0) -> Motion:
        return seen(np.array([step_m, 0.0, 0.0]), self.rng)


@pytest.mark.parametrize("seed", [70, 71])
@pytest.mark.parametrize(
    "spec",
    [
        DRIVING,
        DriveSpec(speeds_mps=(0.003, 0.05), rate_hz=10.0),
        DriveSpec(slips_per_m=0.5, slip_share=0.95, slip_radps=0.6, rate_hz=15.0),
        DriveSpec(speeds_mps=(0.02, 0.2), slips_per_m=0.0, rate_hz=1.9),
        DriveSpec(speeds_mps=(0.02, 0.2), slips_per_m=0.0, rate_hz=1.0),
    ],
    ids=["driving", "creeping", "slipping", "slow camera", "camera of 1 Hz"],
)
def test_a_drive_without_faults_is_not_suspected(spec: DriveSpec, seed: int) -> None:
    check = Standing(0.15)
    said = [s for _, paths in paths_of(told(spec, 300.0, seed)) for s in check.step(paths, LATE_S)]
    assert said == []


def test_a_picture_that_stands_under_turning_wheels_is_said_within_a_third_of_a_second() -> None:
    rig = Rig()
    assert rig.drive(60) == []
    frames = 0
    while not (said := rig.frame(rig.seen(), ahead(0.01))):
        frames += 1
        assert frames < RATE_HZ / 3.0
    assert said[0].kind is Kind.STANDS


def test_the_pose_is_in_doubt_once_the_wheels_have_gone_half_a_tile_and_may_be_where_they_say() -> None:
    rig = Rig()
    rig.drive(30)
    said = [rig.frame(rig.seen(), ahead(0.01)) for _ in range(60)][-1][0]
    assert said.severity is Severity.IN_DOUBT
    assert said.jump_m > 0.5
    assert said.elsewhere is not None
    assert np.allclose(said.elsewhere, [0.6, 0.0, 0.0], atol=0.02)


def test_it_holds_while_the_wheels_rest_and_ends_when_the_picture_moves() -> None:
    rig = Rig()
    rig.drive(30)
    for _ in range(60):
        rig.frame(rig.seen(), ahead(0.01))
    assert [s.kind for s in rig.frame(rig.seen(), still())] == [Kind.STANDS]
    for _ in range(5):
        said = rig.frame(rig.seen(0.01), ahead(0.01))
    assert said == []


def test_a_turn_on_the_spot_is_noticed_as_well() -> None:
    rig = Rig()
    said = [s for _ in range(30) for s in rig.frame(rig.seen(), ahead(0.0, 0.02))]
    assert said and said[0].kind is Kind.STANDS
    assert said[-1].jump_rad == pytest.approx(1.1 * 0.02 * 29, rel=0.1)


def test_wheels_that_rattle_in_their_play_are_no_motion() -> None:
    rig = Rig()
    said = [s for k in range(300) for s in rig.frame(rig.seen(), ahead(0.008 * (-1) ** k))]
    assert said == []


def test_a_robot_without_wheels_is_not_suspected() -> None:
    rig = Rig()
    assert [s for k in range(90) for s in rig.frame(rig.seen(0.01 * (k < 45)), None)] == []


def test_a_pushed_robot_is_noted_and_not_in_doubt() -> None:
    rig = Rig()
    rig.drive(10)
    for _ in range(30):
        rig.frame(rig.seen(), still())
    said = [s for _ in range(30) for s in rig.frame(rig.seen(0.02), still())]
    assert {s.kind for s in said} == {Kind.MOVES}
    assert {s.severity for s in said} == {Severity.NOTED}


def test_a_leap_of_the_picture_while_the_wheels_stand_is_a_doubt() -> None:
    rig = Rig()
    for _ in range(30):
        rig.frame(rig.seen(), still())
    (said,) = rig.frame(rig.seen(0.12), still())
    assert (said.kind, said.severity) == (Kind.JUMPED, Severity.IN_DOUBT)


@pytest.mark.parametrize(("frames", "elapsed_s"), [(2, 1 / 30), (1, 0.1), (6, 1 / 30), (300, 1 / 30)])
def test_blind_frames_on_the_spot_are_a_doubt_of_what_a_hand_can_do_in_that_time(frames: int, elapsed_s: float) -> None:
    rig = Rig()
    for _ in range(30):
        rig.frame(rig.seen(), still(), elapsed_s)
    assert [s for _ in range(frames) for s in rig.frame(blind(NOTHING), still(), elapsed_s)] == []
    (said,) = rig.frame(rig.seen(), still(), elapsed_s)
    assert (said.kind, said.severity) == (Kind.LIFTED, Severity.IN_DOUBT)
    assert said.jump_m == pytest.approx(CARRY_MPS * (frames + 1) * elapsed_s)
    assert said.jump_rad <= math.pi
    assert rig.frame(rig.seen(), still(), elapsed_s) == []


def test_blind_frames_on_the_way_are_no_lifting() -> None:
    rig = Rig()
    rig.drive(30)
    assert [s for _ in range(10) for s in rig.frame(blind(np.array([0.01, 0.0, 0.0])), ahead(0.01))] == []
    assert rig.frame(rig.seen(0.01), ahead(0.01)) == []


def test_a_frame_left_out_by_a_busy_computer_is_no_lifting_but_half_a_second_without_frames_is() -> None:
    rig = Rig()
    for _ in range(30):
        rig.frame(rig.seen(), still())
    assert rig.frame(rig.seen(), still(), 0.3) == []
    (said,) = rig.frame(rig.seen(), still(), 0.6)
    assert said.kind is Kind.LIFTED


def test_the_frames_of_a_slow_camera_are_no_lifting_but_two_periods_without_one_are() -> None:
    """At 1.9 Hz a robot was in doubt whenever it stood, time and again, until a wrong place seemed sure."""
    rig = Rig()
    assert [s for _ in range(30) for s in rig.frame(rig.seen(), still(), 0.53)][1:] == []
    (said,) = rig.frame(rig.seen(), still(), 1.06)
    assert said.kind is Kind.LIFTED


def test_wheels_that_spin_under_a_slow_camera_are_said() -> None:
    rig = Rig()
    said = [s for _ in range(4) for s in rig.frame(rig.seen(), ahead(0.1), 0.6)]
    assert {s.kind for s in said} == {Kind.STANDS}


def test_a_picture_that_is_late_may_move_on_after_the_wheels_have_stopped() -> None:
    rig = Rig()
    rig.drive(30, 0.02)
    said = [s for k in range(60) for s in rig.frame(rig.seen(0.02 * (k < LATE_S * RATE_HZ)), still())]
    assert said == []
