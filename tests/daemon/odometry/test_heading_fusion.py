"""The rotation a step reports: lines where they can be believed, points over the frames where they cannot."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.daemon.odometry.heading_fusion import HeadingFusion, HeadingState

_LINES_RAD, _POINTS_RAD = 0.0002, 0.001
_small = st.floats(-0.03, 0.03)


def drive(lies_rad: np.ndarray, seed: int = 3) -> np.ndarray:
    """Heading error after every step for a direction of lines that lies by so much in each frame."""
    rng = np.random.default_rng(seed)
    fusion, error, errors = HeadingFusion(), 0.0, []
    for before, now in zip(np.r_[0.0, lies_rad[:-1]], lies_rad, strict=True):
        points = float(rng.normal(0, _POINTS_RAD))
        error += fusion.fuse(float(now - before), _LINES_RAD, points, _POINTS_RAD).theta_rad
        errors.append(error)
    return np.array(errors)


@given(st.lists(_small, min_size=1, max_size=20))
def test_lies_of_the_lines_are_paid_back_when_they_end(lies_rad: list[float]) -> None:
    honest = np.zeros(60)
    errors = drive(np.r_[lies_rad, honest])
    assert abs(errors[-1]) < 1e-9
    within = 3 * np.hypot(_LINES_RAD, _POINTS_RAD * np.sqrt(1 + np.arange(len(errors)))) + 4 * _POINTS_RAD
    assert np.all(np.abs(errors) < 2 * within), "no lie reaches the heading by more than the points' own error allows"


def test_points_do_not_make_a_believed_direction_drift() -> None:
    errors = np.abs(drive(np.zeros(5000)))
    assert np.median(errors) < 1e-9
    assert errors.max() < 8 * _POINTS_RAD, "one that was not believed for a few frames"


def test_a_lasting_change_of_the_lines_is_not_followed_at_once() -> None:
    errors = drive(np.full(5, 0.02))
    assert np.abs(errors).max() < 0.01


def test_the_choice_says_how_well_it_is_known() -> None:
    fusion = HeadingFusion()
    agreed = fusion.fuse(0.01, _LINES_RAD, 0.0101, _POINTS_RAD)
    assert (agreed.theta_rad, agreed.sigma_rad, agreed.of_points) == (0.01, _LINES_RAD, False)
    apart = fusion.fuse(0.05, _LINES_RAD, 0.0, _POINTS_RAD)
    assert (apart.theta_rad, apart.sigma_rad, apart.of_points) == (0.0, _POINTS_RAD, True)
    back = fusion.fuse(-0.05, _LINES_RAD, 0.0, _POINTS_RAD)
    assert back.theta_rad == pytest.approx(0.0, abs=1e-15)
    assert back.sigma_rad == pytest.approx(np.hypot(_LINES_RAD, _POINTS_RAD))


def test_a_lost_reference_forgets_what_was_open() -> None:
    fusion = HeadingFusion()
    fusion.fuse(0.05, _LINES_RAD, 0.0, _POINTS_RAD)
    fusion.state = HeadingState()
    assert fusion.fuse(0.0, _LINES_RAD, 0.0, _POINTS_RAD).theta_rad == 0.0
