"""The prior of a robot's tilt: it quietens what only noise says, and gives way to what is there."""

from dataclasses import dataclass

import numpy as np
import pytest

from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.snapshot import freeze, restore, snapshot_json
from ceilvo.daemon.vision.tilt_prior import NOTHING_LATELY, Lately, TiltState, TiltTracker
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Lines

SEED = 11


@dataclass
class Seen:
    """The two fields of Lines that the tracker reads."""

    free_tilt_rad: np.ndarray
    free_tilt_sigma_rad: np.ndarray


def track(tilts: np.ndarray, noise: float, claimed: float | None = None, seed: int = SEED) -> TiltTracker:
    """claimed: standard deviation that frames say, else that of their noise."""
    rng, tracker = np.random.default_rng(seed), TiltTracker()
    for t in tilts:
        seen: object = Seen(t + rng.normal(0, noise, 2), np.full(2, claimed or noise))
        assert not isinstance(seen, Lines)
        tracker.update(seen)  # type: ignore[arg-type]
    return tracker


def weak(tilts: np.ndarray, seed: int = SEED) -> TiltTracker:
    """Frames that are right to .05 deg and are not believed to more than .4, as widened() has it."""
    return track(tilts, float(np.radians(0.05)), float(np.radians(0.4)), seed)


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


@pytest.mark.parametrize("seed", range(4))
def test_frames_that_each_leave_the_tilt_open_tell_together_that_a_robot_rocks(seed: int) -> None:
    rng, k = np.random.default_rng(seed), np.arange(40)
    rates, starts = rng.uniform(0.5, 2.0, 2), rng.uniform(0.0, 2.0 * np.pi, 2)
    tilts = np.radians(2.0 / np.sqrt(2.0)) * np.sin(starts + 2.0 * np.pi * rates * k[:, None] / 30.0)
    prior = weak(tilts, seed).prior()
    print(f"seed {seed}: {np.degrees(np.std(tilts, axis=0))} deg, {prior}")
    assert prior is not None
    assert np.all(np.abs(tilts) < 3.0 * prior.sigma_rad)
    assert np.max(prior.sigma_rad) < np.radians(4.0)


@pytest.mark.parametrize("mistaken_deg", [0.0, 0.3, 1.0])
def test_a_tilt_that_few_lines_mistake_is_no_rocking(mistaken_deg: float) -> None:
    """It stays; below two lamps it was .28 deg in the median of the frames."""
    assert weak(np.full((40, 2), np.radians(mistaken_deg))).prior() is None


def test_edges_that_are_mistaken_within_what_they_claim_are_no_rocking() -> None:
    """Those of two lamps mistake the tilt by another angle every second."""
    tracker = weak(np.radians(0.5) * np.sin(np.arange(40) / 3.0)[:, None] * np.ones(2))
    assert tracker.prior() is None
    assert abs(tracker.scatter_rad() - np.radians(0.45)) < np.radians(0.15), "but a held tilt is known no better"


def test_one_frame_in_three_that_knows_its_tilt_tells_that_a_robot_rocks() -> None:
    """Their median claim is 3 deg, which would explain all of it (drawn-13 of seed 233)."""
    rng, tracker = np.random.default_rng(SEED), TiltTracker()
    for k in range(20):
        sigma = np.radians(0.15 if k % 3 == 0 else 3.0)
        seen: object = Seen(np.radians(1.2) * np.sin(k) + rng.normal(0.0, 0.3 * sigma, 2), np.full(2, sigma))
        tracker.update(seen)  # type: ignore[arg-type]
    assert tracker.prior() is not None


def test_the_scatter_is_told_from_five_frames_on_and_one_mistake_does_not_make_it() -> None:
    tilts = np.zeros((6, 2))
    tilts[3] = np.radians(1.0)
    assert weak(tilts[:4]).scatter_rad() == 0.0
    assert 0.0 < weak(tilts).scatter_rad() < np.radians(0.15)


@pytest.mark.parametrize("seed", range(3))
def test_a_scatter_that_is_the_frames_own_noise_is_no_rocking(seed: int) -> None:
    """Seams of a photograph that are not parallel: .3 deg from frame to frame, claimed to 1.2, under a level robot."""
    tracker = track(np.zeros((40, 2)), float(np.radians(0.3)), float(np.radians(1.3)), seed)
    assert tracker.scatter_rad() > np.radians(0.2)
    assert tracker.scatter_beyond_noise_rad() == 0.0
    assert tracker.prior() is None


def test_a_state_that_knew_one_kind_of_frames_only_is_read() -> None:
    pipeline = Pipeline(simulated_calibration(), Config(), np.random.default_rng(0))
    tree = snapshot_json(freeze(pipeline), "pfcf")
    tilt = tree["state"]["vision"]["tilt"]
    del tilt["claimed"]
    tilt |= {"faint": True, "of_faint": [True]}
    again = Pipeline(simulated_calibration(), Config(), np.random.default_rng(0))
    restore(again, tree)
    assert len(again.vision.state.tilt.claimed) == 0
    kept = TiltState(lately=np.ones((3, 2)), claimed=np.ones((3, 2)))
    assert len(kept.lately) == 3
    assert len(TiltState(lately=np.ones((3, 2))).lately) == 0, "what tilts were known to is not told"


def lately(tilts_deg: list[float], claimed_deg: list[float]) -> Lately:
    tracker = TiltTracker()
    for tilt, claimed in zip(tilts_deg, claimed_deg, strict=True):
        seen: object = Seen(np.radians([0.0, tilt]), np.radians([0.4, claimed]))
        tracker.update(seen)  # type: ignore[arg-type]
    return tracker.lately(beyond_noise=False)


def test_seams_that_lean_every_frame_alike_are_no_tilt_where_it_was_held_level() -> None:
    """ceiling_still: one of 20 frames was believed, and the pose of a robot that stood was 5 cm off."""
    last = lately([0.9, 0.6, 0.5, 0.7], [0.3, 0.25, 0.3, 0.25])
    assert np.allclose(last.usual_rad(np.zeros(2)), np.radians([0.0, 0.65]))
    assert np.array_equal(last.usual_rad(np.radians([0.0, 0.6])), np.zeros(2)), "one that was believed is kept"


def test_a_tilt_that_some_frames_know_is_a_tilt_in_the_next_one() -> None:
    """Six of a robot that rocks below faint joints: three know it to .08 deg, the others to 1 (faint-3, seed 221)."""
    last = lately([1.2, 0.9, 1.0, -1.0, -0.5, 0.4], [0.08, 0.07, 0.06, 1.6, 1.5, 1.0])
    assert np.array_equal(last.usual_rad(np.zeros(2)), np.zeros(2))
    assert np.array_equal(NOTHING_LATELY.usual_rad(np.zeros(2)), np.zeros(2))
