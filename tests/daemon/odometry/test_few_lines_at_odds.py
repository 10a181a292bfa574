"""An edge that is seen in place of the one beside it moves its crossings by a centimetre; the robot did not jump."""

import numpy as np
import pytest
from drawn_crossings import crossings_at

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.crossing_types import CORNER, LAMP
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.types import Array, Crossings, Motion

RATE_HZ = 30.0
ON_LINE = np.array([[-0.92, -1.4], [-0.92, 0.23], [-0.92, 0.4]])
"""Where the end of a row's lamps crosses its edges."""
POINTS = np.array([[-0.15, 0.32], [-0.55, -0.88], [-1.77, -0.3], [0.6, 0.3], [0.2, -0.9]])
LINE_SIGMA_M, POINT_SIGMA_M = 0.0005, 0.0015
BESIDE_M = 0.016
"""From the end of a lamp to that of its frame."""


def seen(pose: Array, line_off_m: float, rng: np.random.Generator) -> Crossings:
    """What a robot at a pose sees of a ceiling that goes on with it, but for that pose."""
    at = np.concatenate([ON_LINE + np.array([line_off_m, 0.0]), POINTS])
    sigma = np.array([LINE_SIGMA_M] * len(ON_LINE) + [POINT_SIGMA_M] * len(POINTS))
    xy = se2.transform(se2.inverse(pose), at) + rng.normal(size=at.shape) * sigma[:, None]
    kind = np.array([0] * len(ON_LINE) + [LAMP, CORNER, CORNER, CORNER, CORNER])
    return crossings_at(xy, kind, sigma, float(-pose[2]), 2e-4)


STEP = np.array([0.2 / RATE_HZ, 0.0, 0.0])


def driven(seed: int, mistaken: float, frames: int = 60) -> tuple[Array, list[Motion]]:
    """(K,) errors of the motions along the rows of a slow drive, m, and the motions; part of the views is mistaken."""
    rng, odometry, pose = np.random.default_rng(seed), VisualOdometry(Odometry()), np.zeros(3)
    motions = []
    for k in range(frames):
        off = BESIDE_M * float(rng.choice([-1.0, 1.0])) if k > 10 and rng.random() < mistaken else 0.0
        motion = odometry.step(seen(pose, off, rng), 1.0 / RATE_HZ)
        if k:
            motions.append(motion)
        pose = se2.compose(pose, STEP)
    return np.array([m.prev_from_curr[0] - STEP[0] for m in motions if m.ok]), motions


@pytest.mark.parametrize("mistaken", [0.05, 0.1, 0.3])
def test_an_edge_in_place_of_its_neighbour_does_not_move_the_robot(mistaken: float) -> None:
    worst = []
    for seed in range(30):
        errors, motions = driven(seed, mistaken)
        assert len(errors) > 0.9 * len(motions)
        worst.append(float(np.max(np.abs(errors))))
    print(
        f"seeds 0-29, {mistaken}: a motion is {1e3 * np.median(worst):.1f} mm off at most, in the median of 30 drives"
    )
    assert np.median(worst) < 0.004, "one such view moves a fit by 12 mm"


def test_where_nothing_is_mistaken_it_changes_nothing_much() -> None:
    assert max(float(np.max(np.abs(driven(seed, 0.0)[0]))) for seed in range(100, 115)) < 0.003


def test_a_robot_that_is_pushed_is_seen_to_be() -> None:
    """All features jump by a centimetre: that is the motion, said with the doubt that it deserves or not at all."""
    rng, odometry, pose = np.random.default_rng(7), VisualOdometry(Odometry()), np.zeros(3)
    way = np.zeros(3)
    for k in range(40):
        motion = odometry.step(seen(pose, 0.0, rng), 1.0 / RATE_HZ)
        way = se2.compose(way, motion.prev_from_curr) if k else way
        last, pose = pose, se2.compose(pose, np.array([0.012 if k == 20 else 0.2 / RATE_HZ, 0.0, 0.0]))
    assert abs(float(se2.between(last, way)[0])) < 0.004
