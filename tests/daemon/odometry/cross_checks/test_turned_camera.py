"""A bumped camera is said within metres, with its angle; small angles and slipping wheels are not."""

from dataclasses import replace

import numpy as np
import pytest
from told_drives import DRIVING, paths_of, told

from ceilvo import se2
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion
from ceilvo.daemon.odometry.cross_checks.turned_camera import TurnedCamera
from ceilvo.types import Displacement, Motion


def bumped(motion: Motion, yaw_rad: float) -> Motion:
    """What a camera sees that is turned: displacements are turned as well, the robot's turn is the same."""
    step = motion.prev_from_curr.copy()
    step[:2] = se2.rotation(-yaw_rad) @ step[:2]
    return replace(motion, prev_from_curr=Displacement(step))


def said_of(deg: float, seconds: float, seed: int, begin_s: float = 0.0) -> tuple[float, list[Suspicion]]:
    """Way since the bump when it is first said (inf: never), and what is said at the end."""
    check, way_m, first_m, said = TurnedCamera(), 0.0, np.inf, []
    drive = ((t, bumped(m, np.radians(deg) * (t > begin_s)), w, dt) for t, m, w, dt in told(DRIVING, seconds, seed))
    way_before = 0.0
    for now_s, paths in paths_of(drive):
        step = np.hypot(*(paths.eye[-1] - paths.eye[-2])[:2]) if len(paths) > 1 else 0.0
        way_before, way_m = way_before + step, way_m + step * (now_s > begin_s)
        said = check.step(paths, 0.0, False)
        if said and not np.isfinite(first_m):
            first_m = way_m
    return float(first_m), said


@pytest.mark.parametrize(("deg", "most_m"), [(5.0, 20.0), (-5.0, 20.0), (10.0, 8.0), (30.0, 8.0)])
@pytest.mark.parametrize("seed", [90, 91])
def test_a_bump_is_said_with_its_angle(deg: float, most_m: float, seed: int) -> None:
    way_m, said = said_of(deg, 240.0, seed, begin_s=60.0)
    assert way_m < most_m
    (suspicion,) = said
    assert (suspicion.kind, suspicion.severity) == (Kind.CAMERA_TURNED, Severity.DEGRADED)
    assert np.degrees(suspicion.jump_rad) == pytest.approx(abs(deg), abs=1.5)
    assert "calib mount" in suspicion.reason


@pytest.mark.parametrize("deg", [0.0, 1.0, -1.0])
def test_what_commissioning_may_leave_is_not_said(deg: float) -> None:
    way_m, said = said_of(deg, 900.0, 92)
    assert not np.isfinite(way_m)
    assert said == []


def test_a_camera_that_is_put_right_is_believed_again() -> None:
    check = TurnedCamera()
    drive = ((t, bumped(m, np.radians(8.0) * (t < 120.0)), w, dt) for t, m, w, dt in told(DRIVING, 300.0, 93))
    said_at = [bool(check.step(paths, 0.0, False)) for _, paths in paths_of(drive)]
    assert any(said_at)
    assert not said_at[-1]
