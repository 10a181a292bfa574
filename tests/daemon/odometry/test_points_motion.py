"""Motion from points without lines: two suffice, and the direction of the lines is carried on."""

from dataclasses import replace

import numpy as np
from drawn_crossings import crossings_at

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.crossing_types import CORNER, JOINTS, LAMP
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.daemon.vision.line_pairing import fold_direction
from ceilvo.se2 import wrap
from ceilvo.types import Array, Crossings

STEP_S = 1.0 / 15.0
SIGMA_M = 0.0005
LAMPS = np.array([[0.6, 0.4], [-0.5, -0.3]])
TILES = np.stack(np.meshgrid(np.arange(-1.2, 1.3, 0.6), np.arange(-1.2, 1.3, 0.6)), -1).reshape(-1, 2)
MOTION = np.array([0.02, 0.0, 0.01])


def seen(pose: Array, at: Array, kind: int, rng: np.random.Generator, psi_rad: float | None = None) -> Crossings:
    """Points of the map at (N, 2) as a robot at a pose sees them; with the direction of lines, or without one."""
    xy = se2.transform(se2.inverse(pose), at) + rng.normal(0.0, SIGMA_M, at.shape)
    directed = {} if psi_rad is None else {"psi_rad": psi_rad, "psi_sigma_rad": 1e-4}
    return crossings_at(xy, kind, SIGMA_M, **directed)


def test_two_lamps_give_the_motion_and_say_how_well() -> None:
    rng, odometry, pose = np.random.default_rng(1), VisualOdometry(Odometry()), np.zeros(3)
    errors, nees = [], []
    for k in range(40):
        motion = odometry.step(seen(pose, LAMPS, LAMP, rng), STEP_S)
        if k > 5:
            assert motion.ok and motion.inliers == 2, motion.failure
            off = se2.between(MOTION, motion.prev_from_curr)
            errors.append(off)
            nees.append(float(off @ np.linalg.solve(motion.cov, off)) / 3.0)
        pose = se2.compose(pose, MOTION)
    assert np.max(np.abs(errors)) < 6.0 * SIGMA_M
    print(f"seed 1: NEES/3 {np.mean(nees):.2f}")
    assert 0.2 < np.mean(nees) < 2.0


def test_two_crossings_of_lines_alone_do_not() -> None:
    """Of crossings three are needed, as before: lines that change places move two alike."""
    rng, odometry = np.random.default_rng(2), VisualOdometry(Odometry())
    for _ in range(5):
        motion = odometry.step(seen(np.zeros(3), LAMPS, JOINTS, rng, 0.0), STEP_S)
    assert not motion.ok


def test_two_other_lamps_are_no_motion() -> None:
    rng, odometry, pose = np.random.default_rng(3), VisualOdometry(Odometry()), np.zeros(3)
    for _ in range(10):
        odometry.step(seen(pose, LAMPS, LAMP, rng), STEP_S)
        pose = se2.compose(pose, MOTION)
    other = LAMPS + np.array([[0.04, 0.0], [-0.04, 0.0]])
    assert not odometry.step(seen(pose, other, LAMP, rng), STEP_S).ok


def test_the_direction_of_the_lines_is_kept_over_a_gap() -> None:
    """Turning under two lamps adds up their errors; the lines take them back."""
    rng, odometry, pose, turned = np.random.default_rng(4), VisualOdometry(Odometry()), np.zeros(3), 0.0
    worst = 0.0
    for k in range(120):
        lines = k < 10 or k >= 100
        both = np.concatenate([LAMPS, TILES]) if lines else LAMPS
        view = seen(pose, both, LAMP, rng, psi_rad=float(-pose[2]) if lines else None)
        motion = odometry.step(view, STEP_S)
        assert motion.ok or k == 0, f"{k}: {motion.failure}"
        turned += float(motion.prev_from_curr[2])
        worst = max(worst, abs(turned - pose[2]))
        pose = se2.compose(pose, np.array([0.0, 0.0, 0.005]))
        if k == 60:
            assert odometry.state.reference is not None
            carried = odometry.state.reference
            assert 1e-4 < carried.psi_sigma_rad < 0.05
            assert abs(carried.psi_rad + 0.005 * k) < 4.0 * carried.psi_sigma_rad
    left = abs(turned - float(pose[2]) + 0.005)
    print(f"seed 4: heading {worst:.5f} rad off at most, {left:.5f} at the end")
    assert left < 5e-4 < worst


def test_a_direction_of_other_lines_is_not_believed() -> None:
    """Hexagons have three: the points' rotation holds."""
    rng, odometry, pose = np.random.default_rng(5), VisualOdometry(Odometry()), np.zeros(3)
    turned = 0.0
    for k in range(40):
        other = np.radians(30.0) if k >= 10 and k % 7 < 3 else 0.0
        motion = odometry.step(seen(pose, TILES[::3], LAMP, rng, psi_rad=float(other - pose[2])), STEP_S)
        assert motion.ok or k == 0, motion.failure
        turned += float(motion.prev_from_curr[2])
        pose = se2.compose(pose, np.array([0.01, 0.0, 0.005]))
    assert abs(turned - 39 * 0.005) < 2e-3


def test_lines_hold_the_heading_where_nothing_crosses() -> None:
    """Slats, or one lamp in view: no motion can be measured, but how the robot turns can."""
    rng, odometry, pose, turned = np.random.default_rng(5), VisualOdometry(Odometry()), np.zeros(3), 0.0
    sigma2 = 0.0
    for k in range(100):
        lines_only = k >= 30
        at = TILES[:0] if lines_only else TILES
        view = replace(seen(pose, at, JOINTS, rng, float(wrap(-pose[2] + rng.normal(0.0, 1e-3)))), psi_sigma_rad=1e-3)
        motion = odometry.step(view, STEP_S)
        assert motion.ok == (0 < k < 30) or k == 0
        if k:
            turned += float(motion.prev_from_curr[2])
        if lines_only:
            sigma2 += float(motion.cov[2, 2])
            assert abs(turned - pose[2]) < 4.0 * np.hypot(1e-3, 1e-3)
            assert sigma2 < 0.02**2
        pose = se2.compose(pose, np.array([0.02, 0.0, 0.02 if lines_only else 0.0]))
    assert pose[2] > 1.3


def test_lines_of_something_else_do_not() -> None:
    rng, odometry = np.random.default_rng(6), VisualOdometry(Odometry())
    for _ in range(5):
        odometry.step(replace(seen(np.zeros(3), TILES, JOINTS, rng, 0.0), psi_sigma_rad=1e-3), STEP_S)
    for psi, sigma in ((0.3, 1e-3), (0.01, 0.02)):
        other = replace(seen(np.zeros(3), TILES[:0], JOINTS, rng, psi), psi_sigma_rad=sigma)
        assert abs(odometry.step(other, STEP_S).prev_from_curr[2]) < 1e-3


CORNERS = np.array([[0.52, -0.28], [0.52, -0.41], [0.52, -0.15], [0.83, 0.29]])
FLICKERS = np.array([[0.0, 0.0], [0.0, 0.0], [-0.010, 0.0], [0.0, 0.021]])
"""How far corners between slats were off from one frame to the next, m; the first is a lamp."""


def _of_slats(pose: Array, rng: np.random.Generator, off: Array, count: int = 4) -> Crossings:
    view = seen(pose, CORNERS[:count], CORNER, rng, fold_direction(-pose[2])[0])
    return replace(
        view, xy_base_m=view.xy_base_m + off[:count], crossing_type=np.array([LAMP, *[CORNER] * (count - 1)])
    )


def test_of_four_points_two_that_are_mistaken_do_not_turn_the_rest_against_the_lines() -> None:
    """The view was said to have jumped: together with one that was mistaken the others fit another rotation best."""
    off, failed = [], 0
    for seed in range(30):
        rng, odometry = np.random.default_rng(seed), VisualOdometry(Odometry())
        for k in range(4):
            motion = odometry.step(_of_slats(k * MOTION, rng, FLICKERS if k == 3 else 0.0 * FLICKERS), STEP_S)
        failed += not motion.ok
        off.append(np.abs(se2.between(se2.between(2 * MOTION, 3 * MOTION), motion.prev_from_curr)))
    worst = np.max(off, axis=0)
    print(f"seeds 0 to 29: {failed} failed, {1e3 * worst[:2].max():.1f} mm, {worst[2]:.4f} rad off at most")
    assert failed == 0
    assert worst[:2].max() < 0.006 and worst[2] < 0.002


def test_one_lamp_and_the_lines_direction_give_the_motion_and_say_how_well() -> None:
    """One lamp can only be itself; what it may be off by in a turn is the direction's part."""
    rng, odometry, pose = np.random.default_rng(7), VisualOdometry(Odometry()), np.zeros(3)
    errors, nees = [], []
    for k in range(60):
        count = 4 if k < 20 else 1
        motion = odometry.step(_of_slats(pose, rng, 0.0 * FLICKERS, count), STEP_S)
        if k > 20:
            assert motion.ok and motion.inliers == 1, motion.failure
            off = se2.between(MOTION, motion.prev_from_curr)
            errors.append(np.abs(off[:2]))
            nees.append(float(off @ np.linalg.solve(motion.cov, off)) / 3.0)
        pose = se2.compose(pose, MOTION)
    print(f"seed 7: {1e3 * np.max(errors):.2f} mm off at most, NEES/3 {np.mean(nees):.2f}")
    assert np.max(errors) < 6.0 * SIGMA_M
    assert 0.05 < np.mean(nees) < 2.0


def test_one_lamp_that_is_another_one_is_no_motion() -> None:
    rng, odometry = np.random.default_rng(8), VisualOdometry(Odometry())
    for k in range(10):
        odometry.step(_of_slats(k * MOTION, rng, 0.0 * FLICKERS, 1), STEP_S)
    assert not odometry.step(_of_slats(10 * MOTION, rng, FLICKERS + 0.09, 1), STEP_S).ok


def test_lines_of_another_direction_that_suffice_again_are_laid_on_what_was_seen_before() -> None:
    """Hexagons show 40 crossings of another of their directions, with corners; then the crossings alone."""
    rng, odometry, pose = np.random.default_rng(9), VisualOdometry(Odometry()), np.zeros(3)
    for k in range(60):
        other = np.radians(30.0) if k >= 10 else 0.0
        view = seen(pose, TILES, JOINTS, rng, fold_direction(other - pose[2])[0])
        if 5 <= k < 40:
            corners = seen(pose, TILES + 0.2, CORNER, rng)
            names = ("uv_px", "xy_base_m", "cov_base_m2", "crossing_type")
            view = replace(view, **{n: np.concatenate([getattr(view, n), getattr(corners, n)]) for n in names})
        motion = odometry.step(view, STEP_S)
        assert k == 0 or motion.ok, f"frame {k}: {motion.failure}"
        if k:
            assert np.abs(se2.between(MOTION, motion.prev_from_curr)).max() < 3e-3
        pose = se2.compose(pose, MOTION)


def test_points_of_another_place_are_not_taken_for_those_that_were_there() -> None:
    rng, taken = np.random.default_rng(4), 0
    for _ in range(300):
        odometry = VisualOdometry(Odometry())
        for k in range(3):
            odometry.step(_of_slats(k * MOTION, rng, 0.0 * FLICKERS), STEP_S)
        elsewhere = rng.uniform(-0.8, 0.8, (4, 2))
        motion = odometry.step(seen(3 * MOTION, elsewhere, CORNER, rng, fold_direction(-3 * MOTION[2])[0]), STEP_S)
        taken += motion.ok
    print(f"seed 4: {taken} of 300 taken")
    assert taken <= 3
