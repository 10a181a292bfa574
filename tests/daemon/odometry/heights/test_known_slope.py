"""A slope of an earlier run: it comes back as it was stored, and the plane goes with the robot's place on the map."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.daemon.odometry.heights.slope import Slope
from ceilvo.sim.rig import simulated_calibration

CALIBRATION = simulated_calibration()
_rise = st.floats(-0.15, 0.15)
_metres = st.floats(-40.0, 40.0)
_poses = st.tuples(_metres, _metres, st.floats(-3.1, 3.1)).map(np.array)
_slopes = st.tuples(_rise, _rise, st.floats(0.8, 1.2))


def known(slope: tuple[float, ...], pose: np.ndarray) -> Slope:
    stage = Slope(CALIBRATION)
    stage.know(slope, pose)
    return stage


@given(_slopes, _poses, _poses)
def test_a_slope_comes_back_as_it_was_stored_wherever_the_robot_is(
    slope: tuple[float, float, float], pose: np.ndarray, way: np.ndarray
) -> None:
    stage = known(slope, pose)
    assert stage.on_map(pose) == pytest.approx(slope, abs=1e-9)
    stage.state.pose = se2.compose(stage.state.pose, way)
    there = se2.compose(pose, way)
    assert stage.on_map(there) == pytest.approx(slope, abs=1e-9)
    assert stage.suspicion == ""


@given(_slopes, _poses, _poses)
def test_the_plane_stays_on_the_map_where_the_robot_is_found_elsewhere(
    slope: tuple[float, float, float], pose: np.ndarray, found: np.ndarray
) -> None:
    stage = known(slope, pose)
    stage.state.here = found
    stage.placed(None, None)
    assert stage.on_map(found) == pytest.approx(slope, abs=0.01), "5 cm and half a degree off are left"


def test_a_level_ceiling_is_no_slope() -> None:
    stage = known((), np.zeros(3))
    assert stage.state.used is None and stage.on_map(np.zeros(3)) == ()
