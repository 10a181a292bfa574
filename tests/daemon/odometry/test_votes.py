"""The translation between views whose features are at odds."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.bench.vision.conditions import conditions
from ceilvo.config import Config
from ceilvo.crossing_types import LAMP
from ceilvo.daemon.odometry.lines.votes import agreed
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.se2 import between, rotation
from ceilvo.types import Array, Frame, Ints

SIGMA_M = 5e-4
PREDICTED_SIGMA_M = 7e-3
"""A frame at 15 Hz."""
EDGE_M = np.array([-0.028, -0.02, -0.016, -0.008, 0.008, 0.016, 0.02, 0.028])
"""How far off crossings are of edges that were taken for the one beside."""
SEEDS = st.integers(0, 2**32 - 1)


def grid(rng: np.random.Generator, wrong: tuple[int, int], lines: int = 9) -> tuple[Array, Array, Array]:
    """Places (N, 2) of crossings of lines along x and y, displacements (N, 2), and the true one (2,): so many lines
    along each axis were taken for the edge beside."""
    true = rng.normal(0.0, PREDICTED_SIGMA_M, 2)
    off = np.zeros((2, lines))
    for axis in (0, 1):
        off[axis, rng.permutation(lines)[: wrong[axis]]] = rng.permutation(EDGE_M)[: wrong[axis]]
    off += rng.normal(0.0, SIGMA_M, off.shape)
    where = np.sort(rng.uniform(-1.5, 1.5, (2, lines)), axis=1) + np.arange(lines) * 2e-3
    i, j = (index.ravel() for index in np.indices((lines, lines)))
    kept = rng.random(len(i)) < 0.4
    at, away = np.column_stack([where[0, i], where[1, j]]), np.column_stack([off[0, i], off[1, j]])
    return at[kept], true + away[kept], true


def translated(at: Array, off: Array, kinds: Ints, axis_rad: float = 0.0, sigma_m: float = PREDICTED_SIGMA_M) -> Array:
    """Result (2,) where nothing is predicted to have moved, all of it turned by axis_rad and back."""
    turn = rotation(axis_rad)
    sigma, cov = np.full(len(at), SIGMA_M), sigma_m**2 * np.eye(2)
    return np.asarray(agreed(off @ turn.T, at @ turn.T, kinds, sigma, axis_rad, np.zeros(2), cov).translation @ turn)


@given(SEEDS, st.integers(0, 4), st.integers(0, 4), st.floats(-3.0, 3.0))
@settings(max_examples=100, deadline=None)
def test_lines_that_were_taken_for_the_edge_beside_move_nothing(seed: int, a: int, b: int, axis_rad: float) -> None:
    """Up to four of nine, each off by another edge: least squares is then millimetres off."""
    at, off, true = grid(np.random.default_rng(seed), (a, b))
    found = translated(at, off, np.full(len(at), 4), axis_rad)
    assert np.max(np.abs(found - true)) < 3.0 * SIGMA_M


def test_a_line_has_one_vote_however_many_cross_it() -> None:
    """Twenty crossings of one line that is 20 mm off, and three lamps that agree."""
    line = np.column_stack([np.linspace(-1.5, 1.5, 20), np.zeros(20)])
    at = np.concatenate([line, [[0.3, 0.4], [-0.8, 0.9], [1.1, -1.0]]])
    off = np.concatenate([np.tile([0.0, 0.02], (20, 1)), np.zeros((3, 2))])
    kinds = np.concatenate([np.full(20, 4), np.full(3, LAMP)])
    assert np.max(np.abs(translated(at, off, kinds))) < SIGMA_M
    assert translated(at, off, np.full(23, LAMP))[1] > 0.019, "as points they are a majority"


def test_two_that_are_as_likely_are_both_in_the_covariance() -> None:
    at, off = np.array([[0.5, 0.0], [-0.5, 0.3]]), np.array([[0.0, 0.0], [0.0, 0.006]])
    most = agreed(off, at, np.full(2, LAMP), np.full(2, SIGMA_M), 0.0, np.array([0.0, 0.003]), np.diag([4e-4, 4e-4]))
    assert 0.002 < np.sqrt(most.cov[1, 1]) < 0.006
    assert np.sqrt(most.cov[0, 0]) < SIGMA_M
    assert np.count_nonzero(most.used) == 1


def test_errors_are_as_large_as_said() -> None:
    """Where two of nine lines are off: 300 views, normalised errors along both axes."""
    rng, z = np.random.default_rng(11), []
    for _ in range(300):
        at, off, true = grid(rng, (2, 2))
        cov = PREDICTED_SIGMA_M**2 * np.eye(2)
        most = agreed(off, at, np.full(len(at), 4), np.full(len(at), SIGMA_M), 0.0, np.zeros(2), cov)
        z.append((most.translation - true) / np.sqrt(np.diag(most.cov)))
    found = float(np.mean(np.square(z)))
    print(f"seed 11: NEES/2 {found:.2f}")
    assert found < 1.5


def test_edges_of_strip_lamps_that_come_and_go_do_not_move_the_robot() -> None:
    """15 Hz: the prediction is known to 7 mm, and edges 8 to 28 mm apart are found by turns."""
    seed, off_mm = 207, []
    world = next(c for c in conditions() if c.name == "strips-only").with_seed(seed).world()
    world.start(0)
    pipeline, before = Pipeline(world.calibration, Config(), np.random.default_rng(1)), None
    for k in range(150):
        t_s = k / 15.0
        estimate, true = pipeline.step(Frame(k, round(t_s * 1e9), world.frame_at(t_s))), world.truth_at(t_s)
        if before is not None:
            off_mm.append(1e3 * float(np.hypot(*(estimate.motion.prev_from_curr - between(before, true))[:2])))
        before = true
    print(f"seed {seed}: motions {max(off_mm):.1f} mm off at most, {np.median(off_mm):.2f} in the median")
    assert max(off_mm[15:]) < 4.0, "14 without votes"
