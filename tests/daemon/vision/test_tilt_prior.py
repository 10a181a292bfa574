"""The prior of a robot's tilt: it quietens what only noise says, and gives way to what is there."""

from dataclasses import dataclass

import numpy as np
import pytest

from ceilvo.daemon.vision.tilt_prior import TiltTracker
from ceilvo.types import Lines

SEED = 11


@dataclass
class Seen:
    """The two fields of Lines that the tracker reads."""

    free_tilt_rad: np.ndarray
    free_tilt_sigma_rad: np.ndarray


def track(tilts: np.ndarray, noise: float) -> TiltTracker:
    rng, tracker = np.random.default_rng(SEED), TiltTracker()
    for t in tilts:
        seen: object = Seen(t + rng.normal(0, noise, 2), np.full(2, noise))
        assert not isinstance(seen, Lines)
        tracker.update(seen)  # type: ignore[arg-type]
    return tracker


def test_no_prior_before_enough_was_seen() -> None:
    assert TiltTracker().prior() is None
    assert track(np.zeros((14, 2)), 1e-4).prior() is None


def test_a_robot_that_does_not_tilt_gets_a_prior_tighter_than_one_frame() -> None:
    prior = track(np.zeros((300, 2)), 1e-4).prior()
    assert prior is not None
    assert np.abs(prior.mean_rad).max() < 5e-5
    assert prior.sigma_rad.max() < 7e-5


def test_a_constant_lean_becomes_the_mean() -> None:
    prior = track(np.tile([0.01, -0.005], (300, 1)), 1e-4).prior()
    assert prior is not None
    assert np.abs(prior.mean_rad - [0.01, -0.005]).max() < 1e-4


@pytest.mark.parametrize("amplitude", [0.005, 0.03])
def test_a_robot_that_rocks_gets_a_prior_as_wide_as_it_rocks(amplitude: float) -> None:
    t = np.arange(300)
    tilts = amplitude * np.column_stack([np.sin(t / 3.0), np.cos(t / 4.0)])
    prior = track(tilts, 1e-4).prior()
    assert prior is not None
    assert (prior.sigma_rad > 0.7 * amplitude).all()
    assert (prior.sigma_rad < 2.0 * amplitude).all()
