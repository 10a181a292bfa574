"""A bumped camera is said within metres, with its angle; small angles and slipping wheels are not."""

from dataclasses import replace

import numpy as np
import pytest
from told_drives import DRIVING, paths_of, told

from ceilvo import se2
from ceilvo.bench.cross_checks.drives import DriveSpec
from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion
from ceilvo.daemon.odometry.cross_checks.turned_camera import TurnedCamera
from ceilvo.types import Displacement, Motion, WheelMotion

SLIPPING = replace(DRIVING, slips_per_m=0.5, slip_share=0.95, slip_radps=0.6, wheel_turn_scale=0.9)


def bumped(motion: Motion, yaw_rad: float) -> Motion:
    """What a camera sees that is turned: displacements are turned as well, the robot's turn is the same."""
    step = motion.prev_from_curr.copy()
    step[:2] = se2.rotation(-yaw_rad) @ step[:2]
    return replace(motion, prev_from_curr=Displacement(step))


def said_of(
    deg: float, seconds: float, seed: int, begin_s: float = 0.0, jump: bool = False, bend: bool = False
) -> tuple[dict[Kind, float], list[Suspicion], float]:
    """Way since the bump when each kind is first said, what is said at the end, and the angle then.

    Args:
        jump: the bump happens while the camera looks, so the picture turns at once; the robot goes straight on then, or
            with `bend` in a steady turn.
    """
    check, way_m, first_m, said, paths = TurnedCamera(), 0.0, {}, [], Paths()
    begun = False
    for now_s, motion, wheels, elapsed_s in told(DRIVING, seconds, seed):
        turned = abs(float(paths.wheels[-1, 2] - paths.wheels_at(now_s - 0.5)[2])) if len(paths) else 0.0
        on = now_s > begin_s and (begun or not jump or (0.3 < turned < 0.6 if bend else turned < 0.01))
        step = bumped(motion, np.radians(deg) * on)
        if jump and on and not begun:
            step = replace(
                step, prev_from_curr=Displacement(step.prev_from_curr + np.array([0.0, 0.0, np.radians(deg)]))
            )
        begun |= on
        way_m += float(np.hypot(*motion.prev_from_curr[:2])) * on
        paths.add(step, wheels, elapsed_s)
        said = check.step(paths, 0.0, 0.2, False)
        for s in said:
            first_m.setdefault(s.kind, way_m)
    return first_m, said, float(np.degrees(check.yaw_rad))


@pytest.mark.parametrize(("deg", "most_m"), [(5.0, 20.0), (-5.0, 20.0), (10.0, 8.0), (30.0, 8.0)])
@pytest.mark.parametrize("seed", [90, 91])
def test_a_camera_that_was_bumped_in_the_dark_is_said_with_its_angle(deg: float, most_m: float, seed: int) -> None:
    first_m, said, yaw_deg = said_of(deg, 240.0, seed, begin_s=60.0)
    assert first_m[Kind.CAMERA_TURNED] < most_m
    (suspicion,) = said
    assert (suspicion.kind, suspicion.severity) == (Kind.CAMERA_TURNED, Severity.DEGRADED)
    assert yaw_deg == pytest.approx(-deg, abs=1.5)
    assert f"{yaw_deg:+.1f} deg" in suspicion.reason and "calib mount" in suspicion.reason


@pytest.mark.parametrize("deg", [4.0, -5.0, 12.0])
@pytest.mark.parametrize("seed", [94, 95])
def test_a_bump_in_the_light_is_said_at_once_and_explained_soon(deg: float, seed: int) -> None:
    first_m, said, yaw_deg = said_of(deg, 200.0, seed, begin_s=60.0, jump=True)
    assert first_m[Kind.KNOCKED] < 0.1
    assert first_m[Kind.CAMERA_TURNED] < 8.0
    assert [s.kind for s in said] == [Kind.CAMERA_TURNED]
    assert yaw_deg == pytest.approx(-deg, abs=1.5)


@pytest.mark.parametrize("seed", [94, 95])
def test_a_bump_in_a_bend_is_said_at_once_too(seed: int) -> None:
    assert said_of(8.0, 200.0, seed, begin_s=60.0, jump=True, bend=True)[0][Kind.KNOCKED] < 0.1


def test_an_eye_in_a_bend_while_the_wheels_go_straight_says_nothing_of_the_camera() -> None:
    """As behind stamps that run at another rate: a bump of 9 deg was said, and the heading "corrected" by it."""
    check, paths = TurnedCamera(), Paths()
    motion = next(told(DRIVING, 1.0, 1))[1]
    for _ in range(900):
        wheels = WheelMotion(Displacement(np.array([0.02, 0.0, 0.0])), np.diag([1e-6, 1e-6, 1e-6]))
        paths.add(replace(motion, prev_from_curr=Displacement(np.array([0.02, 0.0, 0.02]))), wheels, 0.033)
        assert Kind.CAMERA_TURNED not in {s.kind for s in check.step(paths, 0.0, 0.2, False)}


def test_a_robot_that_was_knocked_itself_has_its_camera_where_it_was() -> None:
    check, paths, kinds = TurnedCamera(), Paths(), []
    for now_s, motion, wheels, elapsed_s in told(DRIVING, 120.0, 96):
        knock = np.array([0.0, 0.0, 0.1 * (60.0 < now_s <= 60.0 + elapsed_s)])
        paths.add(replace(motion, prev_from_curr=Displacement(motion.prev_from_curr + knock)), wheels, elapsed_s)
        kinds.append({s.kind for s in check.step(paths, 0.0, 0.2, False)})
    assert {Kind.KNOCKED} in kinds
    assert kinds[-1] == set()
    assert not any(Kind.CAMERA_TURNED in k for k in kinds)


@pytest.mark.parametrize("spec", [DRIVING, SLIPPING], ids=["driving", "slipping"])
def test_wheels_that_slip_in_yaw_are_no_knock(spec: DriveSpec) -> None:
    check = TurnedCamera()
    assert [s for _, paths in paths_of(told(spec, 600.0, 97)) for s in check.step(paths, 0.0, 0.2, False)] == []


@pytest.mark.parametrize("deg", [0.0, 1.0, -1.0])
def test_what_commissioning_may_leave_is_not_said(deg: float) -> None:
    assert said_of(deg, 900.0, 92) == ({}, [], 0.0)


def test_a_camera_that_is_put_right_is_believed_again() -> None:
    check = TurnedCamera()
    drive = ((t, bumped(m, np.radians(8.0) * (t < 120.0)), w, dt) for t, m, w, dt in told(DRIVING, 300.0, 93))
    said_at = [bool(check.step(paths, 0.0, 0.2, False)) for _, paths in paths_of(drive)]
    assert any(said_at)
    assert not said_at[-1]
