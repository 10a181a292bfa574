"""A gap of vision that ranges or marks bridge, many times over, against the truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ceilvo import se2
from ceilvo.daemon.relocalisation.beacons.anchors import AnchorTable
from ceilvo.daemon.relocalisation.beacons.bridge import Bridge
from ceilvo.daemon.relocalisation.beacons.mark_poses import MarkPose, derivatives
from ceilvo.senses.beacons import Anchor
from ceilvo.sim.radio import Radio, RadioSpec, in_corners, surveyed
from ceilvo.types import Array, Displacement, Motion

TAG_M = np.array([0.2, 0.0, 0.5])
STEP = np.array([0.05, 0.0, 0.003])
STEP_SIGMA = np.array([0.01, 0.01, 0.01])
"""Of a step of 0.1 s: a base whose wheels slip a good deal."""
START = np.diag([1e-6, 1e-6, 1e-6])


def gap_of(rng: np.random.Generator, steps: int) -> tuple[list[Motion], list[Array]]:
    """What prediction says since the beginning of a gap, step by step, and where the robot really was by then (3,)."""
    predicted, cov, true = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    motions, truths = [], []
    for _ in range(steps):
        cov = se2.compose_cov(predicted, cov, STEP, np.diag(STEP_SIGMA**2))
        predicted = np.asarray(se2.compose(predicted, STEP))
        true = np.asarray(se2.compose(true, STEP + STEP_SIGMA * rng.standard_normal(3)))
        motions.append(Motion(Displacement(predicted), cov, 0, 0.0, "dark"))
        truths.append(true)
    return motions, truths


def off(bridge: Bridge, true: Array) -> tuple[float, float]:
    """Distance to the truth, and squared distance over the covariance."""
    pose, cov = bridge.pose
    error = np.array(pose - true)
    error[2] = se2.wrap(float(error[2]))
    return float(np.hypot(error[0], error[1])), float(error @ np.linalg.solve(cov, error))


def test_ranges_bound_what_prediction_loses() -> None:
    bridged, nees, plain = [], [], []
    for seed in range(25):
        rng = np.random.default_rng(seed)
        anchors = in_corners(np.zeros(2), np.array([20.0, 20.0]), 4, rng)
        radio = Radio(anchors, RadioSpec(obstructed=0.1), rng)
        table = AnchorTable.of(surveyed(anchors, 0.05, rng), 0.1)
        start = np.array([10.0, 8.0, rng.uniform(-np.pi, np.pi)])
        bridge = Bridge()
        motions, truths = gap_of(rng, 160)
        for k, (motion, moved) in enumerate(zip(motions, truths, strict=True)):
            bridge.move(start, START, motion, table, TAG_M)
            true = np.asarray(se2.compose(start, moved))
            tag = true[:2] + se2.rotation(float(true[2])) @ TAG_M[:2]
            heard = radio.ranges(k, np.array([*tag, TAG_M[2]]))
            which = np.array([table.names.index(r.anchor) for r in heard], np.int64)
            bridge.hear(table, TAG_M, which, np.array([r.range_m for r in heard]), np.zeros((len(heard), 2)))
        distance, squared = off(bridge, np.asarray(se2.compose(start, truths[-1])))
        bridged.append(distance)
        nees.append(squared)
        plain.append(float(np.hypot(*(motions[-1].prev_from_curr - truths[-1])[:2])))
    rms, rms_plain = (float(np.sqrt(np.mean(np.square(v)))) for v in (bridged, plain))
    print(f"after 8 m: {rms:.3f} m with ranges, {rms_plain:.3f} m without; NEES per dof {np.mean(nees) / 3.0:.2f}")
    assert rms < 0.6 * rms_plain
    assert np.mean(nees) < stats.chi2(3 * len(nees)).ppf(0.999) / len(nees)


PLACE_SIGMA = PICTURE_SIGMA = np.array([0.01, 0.01, 0.01])
TILT_SIGMA_M = 0.01


class Hung:
    """A mark that hangs beside its place in the file, seen by a camera with a lens on a floor that tilts."""

    def __init__(self, number: int, pose: Array, rng: np.random.Generator) -> None:
        self.number, self.true, self._rng = number, pose, rng
        self._file = pose + PLACE_SIGMA * rng.standard_normal(3)
        self._lens = np.sqrt(0.5) * PICTURE_SIGMA * rng.standard_normal(3)
        self._tilt_m = TILT_SIGMA_M * rng.standard_normal(2)

    def seen_from(self, pose: Array) -> MarkPose:
        seen = se2.between(pose, self.true) + self._lens + np.sqrt(0.5) * PICTURE_SIGMA * self._rng.standard_normal(3)
        seen[:2] += self._tilt_m
        said = np.asarray(se2.compose(self._file, se2.inverse(seen)))
        by_place, by_picture = derivatives(said, self._file)
        place, picture = np.diag(PLACE_SIGMA**2), np.diag(PICTURE_SIGMA**2)
        return MarkPose(self.number, said, by_place, place, by_picture, picture, TILT_SIGMA_M**2)


@pytest.mark.parametrize("every", [20, 40])
def test_marks_hold_the_pose_and_say_how_well(every: int) -> None:
    distance, nees = [], []
    for seed in range(25):
        rng = np.random.default_rng(1000 + seed)
        start, bridge, table = np.array([1.0, 2.0, rng.uniform(-np.pi, np.pi)]), Bridge(), AnchorTable()
        motions, truths = gap_of(rng, 160)
        for k, (motion, moved) in enumerate(zip(motions, truths, strict=True)):
            bridge.move(start, START, motion, table, TAG_M)
            true = np.asarray(se2.compose(start, moved))
            if k % every == 0:
                ahead = np.array([*rng.uniform(-1.0, 1.0, 2), rng.uniform(-np.pi, np.pi)])
                mark = Hung(k, np.asarray(se2.compose(true, ahead)), rng)
            if k % every < 4:
                bridge.see(mark.seen_from(true))
        d, squared = off(bridge, np.asarray(se2.compose(start, truths[-1])))
        distance.append(d)
        nees.append(squared)
    print(f"a mark every {0.05 * every:.0f} m: {np.mean(distance):.3f} m, NEES per dof {np.mean(nees) / 3.0:.2f}")
    assert np.mean(distance) < 0.02 * np.sqrt(every)
    assert np.mean(nees) < stats.chi2(3 * len(nees)).ppf(0.999) / len(nees)


def test_turning_on_the_spot_under_a_mark_keeps_a_heading_that_is_better_than_the_mark() -> None:
    turn = np.array([0.0, 0.0, 0.3])
    sigma = np.array([2e-4, 2e-4, 2e-4])
    error, nees = [], []
    for seed in range(40):
        rng = np.random.default_rng(2000 + seed)
        start, bridge, table = np.array([3.0, -1.0, rng.uniform(-np.pi, np.pi)]), Bridge(), AnchorTable()
        true, predicted, cov = start, np.zeros(3), np.zeros((3, 3))
        mark = Hung(1, np.asarray(se2.compose(true, np.array([0.7, 0.6, 1.0]))), rng)
        for _ in range(60):
            cov = se2.compose_cov(predicted, cov, turn, np.diag(sigma**2))
            predicted = np.asarray(se2.compose(predicted, turn))
            true = np.asarray(se2.compose(true, turn + sigma * rng.standard_normal(3)))
            bridge.move(start, START, Motion(Displacement(predicted), cov, 0, 0.0, "dark"), table, TAG_M)
            bridge.see(mark.seen_from(true))
        error.append(se2.wrap(float(bridge.pose[0][2] - true[2])))
        nees.append(off(bridge, true)[1])
    rms = float(np.sqrt(np.mean(np.square(error))))
    print(f"three turns: {np.degrees(rms):.3f} deg, NEES per dof {np.mean(nees) / 3.0:.2f}")
    assert rms < 0.004, "the mark's own turn is 0.01 rad off"
    assert np.mean(nees) < stats.chi2(3 * len(nees)).ppf(0.999) / len(nees)


def test_without_beacons_it_is_the_prediction() -> None:
    motions, _ = gap_of(np.random.default_rng(1), 50)
    bridge, table = Bridge(), AnchorTable()
    start, cov = np.array([1.0, 2.0, 0.5]), np.diag([1e-4, 2e-4, 1e-5])
    for motion in motions:
        bridge.move(start, cov, motion, table, TAG_M)
    pose, got = bridge.pose
    np.testing.assert_allclose(pose, se2.compose(start, motions[-1].prev_from_curr), atol=1e-9)
    np.testing.assert_allclose(got, se2.compose_cov(start, cov, motions[-1].prev_from_curr, motions[-1].cov), atol=1e-9)


def test_a_path_that_is_obstructed_throughout_does_not_drag_the_pose_along() -> None:
    anchors = tuple(Anchor(n, x, y, 2.0) for n, x, y in (("A", 0.0, 0.0), ("B", 20.0, 0.0), ("C", 10.0, 20.0)))
    table, bridge, start = AnchorTable.of(anchors, 0.1), Bridge(), np.array([10.0, 8.0, 0.0])
    still = Motion(Displacement(np.zeros(3)), np.diag([1e-4, 1e-4, 1e-6]), 0, 0.0, "dark")
    for _ in range(100):
        bridge.move(start, START, still, table, TAG_M)
        tag = start[:2] + TAG_M[:2]
        distance, _ = table.distances(np.arange(3), tag, float(TAG_M[2]))
        bridge.hear(table, TAG_M, np.arange(3), distance + np.array([0.0, 1.2, 0.0]), np.zeros((3, 2)))
    assert np.hypot(*(bridge.pose[0] - start)[:2]) < 0.03
