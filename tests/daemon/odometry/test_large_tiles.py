"""Tiles of 1.25 m, of which a view shows three to six joints: views that miss some are no hand, and a hand is told."""

from __future__ import annotations

import math

import numpy as np
import pytest
from crossing_camera import CrossingCamera, Flaws
from odometry_robot import Robot

from ceilvo import se2
from ceilvo.config import Odometry
from ceilvo.crossing_types import LAMP
from ceilvo.daemon.odometry.course import JUMPED, Course, met_as_foreseen, moved_though_met
from ceilvo.daemon.odometry.registration import Registration, register
from ceilvo.daemon.odometry.rigid import RigidFit
from ceilvo.daemon.relocalisation.doubts import UNLIKELY
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.wander import Wander, driven

TILE_M = 1.25
CEILING = CeilingSpec(room_m=40.0, tile_m=TILE_M, lamp_every=(0, 0), vents=0)
POOR = Flaws(lines=0.1, crossings=0.05)
USUAL = Flaws(lines=0.03, crossings=0.02)
SURE, FAR_M = 1e-4, 0.1


def run(camera: CrossingCamera, poses: np.ndarray, rate_hz: float) -> np.ndarray:
    """(N, 4) of every pose: whether motion failed, the chance of a hand that is said, and of final motions how far they
    are off and whether they begin anew."""
    robot, out = Robot(camera, poses[0], rate_hz), []
    for pose in poses:
        motion, track = robot.step(pose)
        final, gap = track.final, track.gap
        said = max(0.0 if gap is None else gap.doubt, 0.0 if final is None else final.doubt)
        off_m = 0.0 if final is None else float(np.hypot(*robot.error(track)[:2]))
        out.append((not motion.ok, said, off_m, motion.restarted))
    return np.array(out, float)


def test_views_that_miss_joints_are_no_hand() -> None:
    """At 27f54b9 396 of 7200 such frames were one, and odometry began anew 23 times."""
    seeds, found = range(50, 53), []
    for seed in seeds:
        start = np.array([20.0, 20.0, 0.3 * seed])
        poses = np.array(list(driven(Wander(seed), start, 120.0, 10.0)))
        found.append(run(CrossingCamera.under(CEILING, seed, POOR), poses, 10.0))
    failed, said, off_m, anew = np.concatenate(found).T
    hand, anew_often = int(np.count_nonzero(said > UNLIKELY)), int(anew.sum()) - len(found)
    wrong = int(np.count_nonzero((off_m > FAR_M) & (said < SURE) & (anew == 0)))
    print(f"seeds {seeds}: {int(failed.sum())} of {len(said)} failed, {hand} a hand, {anew_often} anew, {wrong} wrong")
    assert wrong == 0
    assert hand < 0.015 * len(said)
    assert anew_often < 5


@pytest.mark.parametrize("rate_hz", [10.0, 30.0])
def test_a_robot_that_is_snatched_by_a_tile_is_told(rate_hz: float) -> None:
    """It takes 0.1 to 0.3 s; afterwards every view fits where the robot was foreseen."""
    times, told, silent = 40, 0, 0
    for seed in range(200, 200 + times):
        rng = np.random.default_rng(seed)
        start = np.array([*rng.uniform(20.0, 21.0, 2), rng.uniform(-3.0, 3.0)])
        poses = np.array(list(driven(Wander(seed), start, 6.0, rate_hz)))
        begin, took_s = int(rate_hz * rng.uniform(2.0, 4.0)), rng.uniform(0.1, 0.3)
        part = np.clip((np.arange(len(poses)) - begin) / rate_hz / took_s, 0.0, 1.0)
        away = TILE_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[rng.integers(4)]
        poses[:, :2] += (3.0 * part**2 - 2.0 * part**3)[:, None] * away
        _, said, off_m, anew = run(CrossingCamera.under(CEILING, seed % 5, USUAL), poses, rate_hz)[begin:].T
        hand = bool(np.any(said > UNLIKELY) or np.any(anew))
        told, silent = told + hand, silent + (not hand and float(np.max(off_m)) > FAR_M)
    print(f"{rate_hz:g} Hz: {told} of {times} told, {silent} wrong and not told")
    assert silent <= 0.1 * times


def course(guess: np.ndarray, sigma_m: float) -> Course:
    cov = np.diag([sigma_m**2, sigma_m**2, 1e-6])
    return Course(guess, cov, 0.1, 0.1, np.zeros(3), 0.1, by_wheels=False, refused=None)


def test_what_is_met_on_the_way_to_another_place_is_counted() -> None:
    """Views anywhere in a tile, laid where the prediction has them: so many crossings meet by chance, or fewer."""
    rng, camera, met, foreseen = np.random.default_rng(6), CrossingCamera.under(CEILING, 1, USUAL), [], []
    here = np.array([20.0, 20.0, 0.2])
    for k in range(2000):
        ref = camera.sees(here, 2 * k)
        moved = np.array([*rng.uniform(-0.5, 0.5, 2) * TILE_M, 0.0])
        seen = camera.sees(se2.compose(here, moved), 2 * k + 1)
        if len(ref) < 3 or len(seen) < 3:
            continue
        one = met_as_foreseen(ref, seen, course(np.zeros(3), 0.02))
        met.append(one[0])
        foreseen.append(one[1])
    counted, mean = float(np.mean(np.array(met) > 0)), float(np.mean(foreseen))
    print(f"met by chance in {counted:.3f}, foreseen {mean:.3f}")
    assert counted < mean < 6.0 * counted


def test_views_without_an_extent_say_nothing_of_a_hand() -> None:
    """One crossing, or several in one place: all others would be met anywhere."""
    here = np.array([20.0, 20.0, 0.2])
    seen = CrossingCamera.under(CEILING, 1, USUAL).sees(here, 1)
    for ref in (seen.of(np.array([0])), seen.of(np.zeros(3, np.int64))):
        met, by_chance = met_as_foreseen(ref, seen, course(np.zeros(3), 0.02))
        assert 0 < met <= by_chance == len(seen)
        assert moved_though_met(met, by_chance) == JUMPED


def test_each_crossing_that_is_met_makes_a_hand_less_likely() -> None:
    chances = [moved_though_met(k, 0.07) for k in range(4)]
    assert chances[0] == JUMPED
    assert chances[1] == pytest.approx(0.07 * JUMPED)
    assert chances[2] == pytest.approx(0.07**2 / 2 * JUMPED)
    assert moved_though_met(3, 5.0) == JUMPED, "a prediction that reaches all of them says nothing"
    assert np.all(np.diff(chances) < 0.0)


def test_a_view_on_an_earlier_one_is_seen_from_the_reference() -> None:
    """Where earlier_from_ref is known with an error, the covariance has it: errors drawn a thousand times agree."""
    camera, rng = CrossingCamera.under(CeilingSpec(room_m=40.0), 2, Flaws(0.0, 0.0, 0.0)), np.random.default_rng(9)
    earlier, ref, curr = (np.array(p) for p in ((20.0, 20.0, 0.1), (20.2, 20.1, 0.4), (20.25, 20.15, 0.6)))
    at, at_cov = se2.between(earlier, ref), np.diag([4e-6, 1e-6, 9e-6])
    place, why = register(camera.sees(earlier, 0), camera.sees(curr, 1), se2.between(earlier, curr), 0.1, Odometry())
    assert place is not None, why
    there = place.seen_from(at, at_cov)
    np.testing.assert_allclose(there.fit.b_from_a, se2.between(ref, curr), atol=2e-3)
    np.testing.assert_allclose(se2.transform(there.fit.b_from_a, there.seen), there.before, atol=3e-3)
    assert there.turn_rad == pytest.approx(0.2, abs=2e-3)
    drawn = []
    for _ in range(4000):
        wrong = at + rng.normal(size=3) * np.sqrt(np.diag(at_cov))
        fit = place.fit.b_from_a + rng.multivariate_normal(np.zeros(3), place.fit.cov)
        drawn.append(se2.between(wrong, fit))
    np.testing.assert_allclose(there.fit.cov, np.cov(np.array(drawn).T), atol=0.08 * np.max(there.fit.cov))
    assert math.sqrt(there.fit.cov[2, 2]) > 0.003


def agreeing(xy: list[list[float]], kinds: list[int]) -> Registration:
    """All of them agree."""
    at, used = np.array(xy), np.ones(len(xy), bool)
    fit = RigidFit(np.zeros(3), used, 0.0, np.eye(3), 1e-6)
    return Registration(fit, at, at, 0.0, len(xy), float(len(xy)), 0, 0.0, np.array(kinds))


JOINT = 4


@pytest.mark.parametrize(
    ("xy", "kinds", "apart"),
    [
        ([[0, 0], [1.25, 0], [0, 1.25], [1.25, 1.25]], [JOINT] * 4, 4.0),
        ([[0, 0], [1.25, 0], [0, 1.25], [1.25, 1.25], [2.5, 0]], [JOINT] * 5, 5.0),
        ([[0, 0], [0.6, 0], [1.2, 0], [1.8, 0], [2.4, 0]], [JOINT] * 5, 2.0),
        ([[-1.63, -0.58], [-1.63, -0.55], [-1.63, -0.01], [-1.63, 0.01]], [6, 6, 8, 8], 2.0),
        ([[0, 0], [0.03, 0.0], [0.03, 0.03], [0, 0.03], [1.2, 0], [0, 0.6], [1.2, 0.6]], [JOINT] * 7, 4.0),
        ([[0.1, 0.2], [0.9, 1.4], [1.3, 0.5]], [LAMP] * 3, 2.0),
        ([[0.1 * k, 0.17 * k] for k in range(6)], [LAMP] * 6, 4.0),
        ([[0, 0], [1.25, 0], [0, 1.25], [1.25, 1.25], [0.4, 0.4]], [JOINT] * 4 + [LAMP], 14.0 / 3.0),
    ],
    ids=["a tile", "and one", "a row", "a lamp's end", "double edges", "three points", "six points", "both"],
)
@pytest.mark.parametrize("axis_rad", [0.0, 0.3])
def test_inliers_that_err_together_count_once(
    xy: list[list[float]], kinds: list[int], apart: float, axis_rad: float
) -> None:
    turned = se2.transform(np.array([0.0, 0.0, axis_rad]), np.array(xy, float)).tolist()
    assert agreeing(turned, kinds).apart(axis_rad) == pytest.approx(apart)
