"""Wheels that misreport every turn, against arithmetic and against drives whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.bench.paper.run import known_map
from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam.joint_filter import JointFilter
from ceilvo.daemon.slam.slip import SCALE_SIGMA, TurnScale
from ceilvo.se2 import compose, inverse, transform, wrap
from ceilvo.types import Array, Displacement, Motion, Observations

SEED = 77
CFG = replace(Filter(), feature_independence=1.0, particles=50)
STEP = np.array([0.05, 0.0, 0.06])
SIGMA = np.array([0.002, 0.002, 0.002])
SEEN_SIGMA_M = 0.02


def wheels(step: Array, sigma: Array = SIGMA) -> Motion:
    return Motion(Displacement(step), np.diag(sigma**2), 9, 0.0, by_wheels=True)


def driven(
    misreported: float, known: bool, heading: bool = False, seed: int = SEED
) -> tuple[JointFilter, Array, Array]:
    """Four circles of 0.8 m among landmarks; wheels report turns that are wrong by a share. Pose, and truth."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2, -1], [2, 3], (40, 2))
    ceiling = known_map(points, np.zeros(len(points), np.int64))
    f = make_filter(CFG, np.random.default_rng(seed))
    assert isinstance(f, JointFilter)
    truth = np.zeros(3)
    f.reset(truth, 1e-8 * np.eye(3), ceiling if known else None, known=known)
    for _ in range(420):
        truth = compose(truth, STEP)
        f.predict(wheels(STEP * [1.0, 1.0, 1.0 / (1.0 + misreported)] + SIGMA * rng.standard_normal(3)))
        at = transform(inverse(truth), points)
        there = np.flatnonzero(np.hypot(*at.T) < 1.0)
        z = at[there] + SEEN_SIGMA_M * rng.standard_normal((len(there), 2))
        var = np.full((len(there), 2), SEEN_SIGMA_M**2)
        told = 1e-4 if heading else float("inf")
        f.update(Observations(z, var, np.zeros(len(there), np.int64), there, float(truth[2]), told))
    return f, f.estimate()[0], truth


@pytest.mark.parametrize("misreported", [-0.4, -0.1, 0.0, 0.25])
def test_the_share_is_learnt_on_a_known_map(misreported: float) -> None:
    """And then holds the heading while nothing is seen; -.4 is four standard deviations of what is foreseen."""
    f, _, truth = driven(misreported, known=True)
    turns: TurnScale = f.state.rule.turns
    for _ in range(40):
        truth = compose(truth, STEP)
        f.predict(wheels(STEP * [1.0, 1.0, 1.0 / (1.0 + misreported)]))
    pose, cov, _ = f.estimate()
    off = abs(wrap(float(pose[2] - truth[2])))
    print(f"seed {SEED}: share {turns.share:.3f} +- {np.sqrt(turns.var):.3f}, {off:.3f} rad off after 2.4 rad")
    assert abs(turns.share - misreported) < 0.02
    assert off < min(0.05, 3.0 * float(np.sqrt(cov[2, 2])))


def test_a_map_that_turns_with_the_pose_teaches_nothing() -> None:
    f, _, _ = driven(-0.1, known=False)
    turns: TurnScale = f.state.rule.turns
    assert turns.share == 0.0 and turns.var == SCALE_SIGMA**2 and not np.any(turns.lever)


def test_a_measured_heading_teaches_while_the_map_is_made() -> None:
    f, pose, truth = driven(-0.2, known=False, heading=True)
    turns: TurnScale = f.state.rule.turns
    print(f"seed {SEED}: share {turns.share:.3f} +- {np.sqrt(turns.var):.3f}")
    assert abs(turns.share + 0.2) < 0.03
    assert abs(wrap(float(pose[2] - truth[2]))) < 0.03


@pytest.mark.parametrize(
    "motion",
    [replace(wheels(STEP), seen=True), replace(wheels(STEP), by_wheels=False), wheels(STEP, np.zeros(3))],
    ids=["vision", "foreseen by the twist", "exact"],
)
def test_what_no_wheel_reported_is_as_it_is(motion: Motion) -> None:
    turns = TurnScale(share=-0.3, told=True)
    assert turns.scaled(motion) is motion
    assert not np.any(turns.moved(STEP[:2], motion))
    assert not np.any(turns.lever)


@given(st.lists(st.tuples(*[st.floats(-0.5, 0.5)] * 3), min_size=1, max_size=20))
def test_the_spreads_of_a_path_are_that_of_its_end(steps: list[tuple[float, float, float]]) -> None:
    """However it turns about: as if the pose at its end were known but for the share."""
    turns, pose, cov = TurnScale(told=True), np.zeros(3), np.zeros((3, 3))
    for step in steps:
        moved = compose(pose, np.array(step))
        way = moved[:2] - pose[:2]
        f = np.eye(3)
        f[:2, 2] = -way[1], way[0]
        cov = f @ cov @ f.T + turns.moved(way, wheels(np.array(step)))
        pose = moved
    np.testing.assert_allclose(cov, SCALE_SIGMA**2 * np.outer(turns.lever, turns.lever), atol=1e-12)
    assert abs(turns.lever[2] - sum(s[2] for s in steps)) < 1e-12


@given(st.floats(-1.0, 1.0), st.floats(-0.5, 0.5), st.floats(-0.3, 0.3))
def test_the_lever_is_the_derivative_of_the_way(x: float, y: float, turn: float) -> None:
    step = np.array([x, y, turn])
    little = 1e-6
    there = TurnScale(share=little).scaled(wheels(step)).prev_from_curr - step
    turns = TurnScale(told=True)
    turns.moved(step[:2], wheels(step))
    np.testing.assert_allclose(there / little, turns.lever, atol=1e-5)
