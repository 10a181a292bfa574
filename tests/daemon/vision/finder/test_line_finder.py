"""Predict-and-verify against full detection and against the simulator's truth."""

from dataclasses import replace

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.config import Features, Odometry
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.daemon.vision.crossings import cross
from ceilvo.daemon.vision.edge_tracking import predicted
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.daemon.vision.line_pairing import EdgeSet
from ceilvo.sim.motion import TiltSpec
from ceilvo.sim.rig import simulated_calibration
from ceilvo.sim.world import World, WorldSpec

SEED = 6
RATE_HZ = 30.0


def world_with(tilt_deg: float) -> World:
    world = World(WorldSpec(seed=SEED, tilt=TiltSpec(amplitude_rad=np.radians(tilt_deg))))
    world.start(0)
    return world


@pytest.mark.parametrize("tilt_deg", [0.0, 2.0])
def test_edge_tracking_holds_while_the_robot_rocks_and_agree_with_the_truth(tilt_deg: float) -> None:
    world = world_with(tilt_deg)
    finder = LineFinder(world.calibration, Features(full_every=10))
    odometry = VisualOdometry(Odometry())
    pose = world.truth_at(1.0)
    off_psi, off_tilt = [], []
    for k in range(90):
        t = 1.0 + k / RATE_HZ
        lines = finder(world.frame_at(t), odometry.expected(1 / RATE_HZ))
        assert lines is not None
        motion = odometry.step(cross(lines, world.calibration, Features()), 1 / RATE_HZ)
        pose = se2.compose(pose, motion.prev_from_curr)
        truth = world.truth_at(t)
        off_psi.append((lines.psi_rad + truth[2] + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        off_tilt.append(lines.tilt_rad - world.tilt_at(t))
    worst_mm = 1e3 * np.hypot(*(pose - truth)[:2])
    tracked, detected = finder.state.tracked, finder.state.detections
    print(f"seed {SEED}, tilt {tilt_deg}: {tracked} tracked, {detected} detected, {worst_mm:.2f} mm at the end")
    assert tracked > 0.6 * (detected + tracked)
    assert np.abs(off_psi).max() < np.radians(0.03)
    assert np.abs(off_tilt).max() < np.radians(0.06)
    assert worst_mm < 4.0


def warmed(world: World) -> tuple[LineFinder, float]:
    finder = LineFinder(world.calibration, Features(full_every=100))
    step = np.array([0.35 / RATE_HZ, 0.0, 0.0])
    t = 2.0
    for _ in range(30):
        t += 1 / RATE_HZ
        assert finder(world.frame_at(t), step) is not None
    assert finder.state.tracked > 5
    return finder, t


def test_a_close_look_sees_the_crossings_of_a_full_one() -> None:
    """Also where a vent's slats end short of a joint: what a map holds must not depend on how one looked."""
    world = world_with(0.0)
    close = LineFinder(world.calibration, Features(full_every=10))
    found, missed, extra = 0, 0, 0
    for k in range(80):
        t = 1.0 + k / RATE_HZ
        step = se2.between(world.truth_at(t - 1 / RATE_HZ), world.truth_at(t))
        lines = close(world.frame_at(t), step)
        if k % 4 or not close.state.tracked:
            continue
        full = LineFinder(world.calibration, Features(full_every=1))(world.frame_at(t), None)
        assert lines is not None and full is not None
        a, b = (cross(seen, world.calibration, Features()).uv_px for seen in (full, lines))
        apart = np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))
        found += int(np.count_nonzero(apart.min(axis=1) < 1.0))
        missed += int(np.count_nonzero(apart.min(axis=1) >= 1.0))
        extra += int(np.count_nonzero(apart.min(axis=0) >= 1.0))
    print(f"seed {SEED}: {found} seen by both, {missed} only by a full look, {extra} only by a close one")
    assert found > 500
    assert missed < 0.1 * found
    assert extra < 0.15 * found


def test_edge_tracking_takes_no_tilt_where_none_is_to_be_estimated() -> None:
    """Else a tilt that only helped to find the edges stays, and the next full look has none: steps to and fro."""
    world = world_with(1.0)
    finder = LineFinder(world.calibration, Features(full_every=10, estimate_tilt=False))
    for k in range(30):
        lines = finder(world.frame_at(2.0 + k / RATE_HZ), np.array([0.35 / RATE_HZ, 0.0, 0.0]))
        assert lines is not None
        assert np.abs(lines.tilt_rad).max() < 1e-9
    assert finder.state.tracked > 10


def test_a_black_frame_is_no_lines_and_a_full_look() -> None:
    world = world_with(0.0)
    finder, t = warmed(world)
    full = finder.state.detections
    assert finder(np.zeros_like(world.frame_at(t)), np.zeros(3)) is None
    assert finder.state.detections == full + 1


def test_a_scene_that_is_not_as_predicted_gets_a_full_look() -> None:
    world = world_with(0.0)
    finder, t = warmed(world)
    full = finder.state.detections
    lines = finder(world.frame_at(t + 6.0), np.zeros(3))
    assert finder.state.detections == full + 1
    assert lines is not None
    truth = world.truth_at(t + 6.0)
    assert abs((lines.psi_rad + truth[2] + np.pi / 4) % (np.pi / 2) - np.pi / 4) < np.radians(0.05)


@pytest.mark.parametrize("tilt_deg", [0.3, 1.0])
def test_a_tilt_that_the_last_seconds_exclude_gets_a_full_look(tilt_deg: float) -> None:
    """Edges of two lamps in a row pass for one line until the robot turns, and then seem bent by a tilt of a degree: a
    close look keeps them, a full one does not. A robot that does tilt is looked at twice, once."""
    finder, t = warmed(world_with(0.0))
    full = finder.state.detections
    leaning = world_with(tilt_deg)
    now = t + max(np.arange(0.0, 0.3, 0.01), key=lambda s: float(np.max(np.abs(leaning.tilt_at(t + s)))))
    lines = finder(leaning.frame_at(now), se2.between(leaning.truth_at(t), leaning.truth_at(now)))
    assert finder.state.detections == full + 1
    assert lines is not None
    assert np.max(np.abs(lines.tilt_rad - leaning.tilt_at(now))) < np.radians(0.06)


def test_without_a_prediction_every_look_is_full() -> None:
    world = world_with(0.0)
    finder, t = warmed(world)
    full = finder.state.detections
    finder(world.frame_at(t), None)
    assert finder.state.detections == full + 1


def test_predicted_edges_of_a_hand_made_move() -> None:
    """A robot that drives 0.1 m forward sees an edge across its way come nearer by 0.1 m."""
    calibration = replace(simulated_calibration(mount_xy_m=(0.05, -0.03)))
    px_per_m = calibration.level_view.focal_px / calibration.ceiling_height_m
    edges = EdgeSet(
        0.0,
        np.array([0, 1]),
        np.array([True, False]),
        np.array([100.0, 20.0]),
        np.array([-50.0, 0]),
        np.array([50.0, 90]),
        np.ones(2),
        0.3,
    )
    ahead = predicted(edges, np.array([0.1, 0.0, 0.0]), calibration)
    assert ahead.offset_px == pytest.approx([100.0 - 0.1 * px_per_m, 20.0])
    turned = predicted(edges, np.array([0.0, 0.0, 0.02]), calibration)
    assert turned.psi_rad == pytest.approx(-0.02)


def test_lines_on_the_ceiling_are_those_that_cross() -> None:
    """Each crossing lies on one line of either axis, whatever camera looks from wherever it is mounted."""
    for calibration in (simulated_calibration(), simulated_calibration(pitch_rad=float(np.radians(24.0)))):
        world = World(WorldSpec(seed=4), calibration)
        lines = LineFinder(calibration, Features())(world.frame_at(12.0), None)
        assert lines is not None
        seen = cross(lines, calibration, Features())
        there = seen.lines
        assert there is not None and len(there.axis) == len(lines.axis) and len(seen) > 10
        for axis in (0, 1):
            angle = seen.psi_rad + axis * 0.5 * np.pi
            offset_m = seen.xy_base_m @ np.array([np.cos(angle), np.sin(angle)])
            off_m = np.abs(offset_m[:, None] - there.offset_m[there.axis == axis])
            assert np.max(np.min(off_m, axis=1)) < 1e-9
