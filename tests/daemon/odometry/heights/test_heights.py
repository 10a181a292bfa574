"""Lines at several heights, drawn by hand: what the stage says of them against where they were drawn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from height_drawings import CALIBRATION, HIGH_M, SEED, TWO_HEIGHTS, grid, seen

from ceilvo import se2
from ceilvo.crossing_types import CORNER, LAMP
from ceilvo.daemon.odometry.heights.stage import Heights
from ceilvo.daemon.odometry.heights.tracks import UNKNOWN, Sharpness
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.types import NO_DIRECTION_RAD, Displacement, Motion

COARSE = simulated_calibration(simulated_camera("pinhole", 160, 120))
POSES = [np.array([0.03 * k, 0.012 * k, 0.005 * k]) for k in range(40)]
"""Of a drive in a bend."""


def drive(heights: Heights, lines: list[tuple[int, float, float]], too_long: float = 1.0) -> Iterator[float]:
    """Drive in a bend; yields the largest error of a crossing that is handed on, m.

    too_long: of the motion that the stage is told, until it knows better.
    """
    rng = np.random.default_rng(SEED)
    for k, pose in enumerate(POSES):
        crossings, true = seen(lines, pose, rng)
        moved = np.zeros(3) if k == 0 else se2.between(POSES[k - 1], pose)
        placed = heights.look(crossings, moved)
        assert placed is not None
        near = np.min(np.hypot(*(placed.xy_base_m[:, None] - true[None]).transpose(2, 0, 1)), axis=1)
        told = moved if heights.several else moved * [too_long, too_long, 1.0]
        heights.learn(Motion(Displacement(told), 1e-6 * np.eye(3), len(placed), 0.0, restarted=k == 0))
        yield float(np.max(near))


@pytest.mark.parametrize("lines", [0, 4])
def test_points_are_no_lines(lines: int) -> None:
    """Lamps and corners have no axes: only crossings of lines are followed, and without any the view is left alone."""
    heights, rng = Heights(CALIBRATION), np.random.default_rng(SEED)
    crossings, _ = seen(grid(HIGH_M, -0.9, 4), np.zeros(3), rng)
    kind = np.where(
        np.arange(len(crossings)) < lines, crossings.crossing_type, np.resize([LAMP, CORNER], len(crossings))
    )
    sigma = crossings.psi_sigma_rad if lines else NO_DIRECTION_RAD
    view = replace(crossings, crossing_type=kind, psi_sigma_rad=sigma)
    assert heights.look(view, None) is view
    heights.learn(Motion(Displacement(np.zeros(3)), 1e-6 * np.eye(3), len(view), 0.0))
    assert len(heights.state.tracks) == (lines + 1 if lines else 0)  # those of one line across, and of each along


def test_one_height_is_left_alone() -> None:
    heights, rng = Heights(CALIBRATION), np.random.default_rng(SEED)
    list(drive(heights, grid(HIGH_M, -1.2, 5)))
    assert not heights.several
    crossings, _ = seen(grid(HIGH_M, -1.2, 5), np.zeros(3), rng)
    assert heights.look(crossings, None) is crossings
    assert heights.reference() is None


@pytest.mark.parametrize("seed", range(12))
def test_a_robot_that_turns_on_the_spot_and_measures_its_way_badly_finds_no_height(seed: int) -> None:
    """The camera moves by centimetres then; a way that is wrong by millimetres is no height, as often as it is seen."""
    heights, rng = Heights(CALIBRATION), np.random.default_rng(seed)
    lines, turn_rad = grid(HIGH_M, -1.3, 3, 1.25), np.arange(60) / 90.0
    begins = float(rng.uniform(-np.pi, np.pi) / 4.0)
    poses = [np.array([0.0, 0.0, begins + t]) for t in turn_rad]
    camera = np.array([se2.transform(pose, CALIBRATION.mount_xy_m[None])[0] for pose in poses])
    off = rng.choice([-1.0, 1.0]) * 0.0045 / np.max(np.abs(camera - camera[0]))
    for k, pose in enumerate(poses):
        crossings, _ = seen(lines, pose, rng)
        moved = np.zeros(3) if k == 0 else se2.between(poses[k - 1], pose)
        if k:
            moved[:2] += se2.rotation(-float(poses[k - 1][2])) @ (off * (camera[k] - camera[k - 1]) * [0.0, 1.0])
        heights.look(crossings, moved)
        heights.learn(Motion(Displacement(moved), 1e-6 * np.eye(3), len(crossings), 0.0, restarted=k == 0))
    print(f"seed {seed}: ratios {heights.state.levels.ratio}, lines' {heights.state.tracks.ratios(Sharpness())[0]}")
    assert not heights.several


@pytest.mark.parametrize("other_m", [HIGH_M - 0.4, HIGH_M - 0.12, HIGH_M + 0.5])
def test_a_second_height_is_found_and_its_crossings_are_put_where_they_are(other_m: float) -> None:
    heights = Heights(CALIBRATION)
    errors = list(drive(heights, grid(HIGH_M, -1.2, 5) + grid(other_m, -0.93, 3, 0.7)))
    found = HIGH_M / heights.state.levels.ratio
    print(f"seed {SEED}: {other_m} m found at {found}; errors {errors[0]:.4f} m at first, {errors[-1]:.4f} m")
    assert len(found) == 2
    assert abs(found[1] - other_m) < 0.01
    assert errors[0] > 0.02, "without heights they lie elsewhere"
    assert errors[-1] < 0.006


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_that_sees_coarsely_finds_a_second_height_too_and_no_other(seed: int) -> None:
    """21 mm of ceiling in a pixel, lines that scatter by 1 mm: judged by what a sharp camera sees, none is steady."""
    heights, rng, before = Heights(COARSE), np.random.default_rng(seed), np.zeros(3)
    for k in range(60):
        pose = k * np.array([0.03, 0.012, 0.0])
        moved = se2.between(before, pose)
        crossings, _ = seen(TWO_HEIGHTS, pose, rng, noise_m=0.001)
        heights.look(crossings, moved)
        heights.learn(Motion(Displacement(moved), 1e-6 * np.eye(3), len(crossings), 0.0, restarted=k == 0))
        before = pose
    found_m = HIGH_M / heights.state.levels.ratio
    print(f"seed {seed}: found {found_m}")
    assert len(found_m) == 2
    assert abs(found_m[1] - (HIGH_M - 0.4)) < 0.03


def test_the_scale_is_found_where_the_way_was_measured_by_both_heights() -> None:
    """Lower lines move past faster; who takes all for the ceiling's drives too far, until the heights are known."""
    heights = Heights(CALIBRATION)
    errors = list(drive(heights, grid(HIGH_M, -1.2, 5) + grid(1.8, -0.93, 3, 0.7), too_long=1.08))
    print(f"seed {SEED}: ratios {heights.state.levels.ratio}")
    assert abs(HIGH_M / heights.state.levels.ratio[1] - 1.8) < 0.015
    assert errors[-1] < 0.008


def test_what_hangs_lower_is_not_taken_for_the_ceiling_though_there_is_as_much_of_it() -> None:
    heights = Heights(CALIBRATION)
    list(drive(heights, grid(HIGH_M, -1.2, 4) + grid(1.7, -0.93, 4, 0.5), too_long=1.15))
    assert heights.state.levels.ratio[0] == 1.0
    assert np.all(heights.state.levels.ratio[1:] > 1.2)


def test_a_new_line_across_lines_of_known_height_is_on_theirs() -> None:
    heights, rng = Heights(CALIBRATION), np.random.default_rng(SEED)
    lines = grid(HIGH_M, -1.2, 5) + grid(1.8, -0.93, 3, 0.7)
    list(drive(heights, lines))
    pose = np.array([0.03 * 40, 0.012 * 40, 0.005 * 40])
    last = np.array([0.03 * 39, 0.012 * 39, 0.005 * 39])
    more = [*lines, (0, 1.9, 1.8)]
    for moved in (se2.between(last, pose), np.zeros(3)):
        crossings, true = seen(more, pose, rng)
        placed = heights.look(crossings, moved)
        heights.learn(Motion(Displacement(moved), 1e-6 * np.eye(3), 9, 0.0))
    assert placed is not None
    assert len(placed) == len(crossings)
    assert placed.complete
    assert np.max(np.hypot(*(placed.xy_base_m - true).T)) < 0.008


@pytest.mark.parametrize("jump", [(0.07, 0.0), (0.0, -0.05), (-0.1, 0.08), (0.2, 0.0)])
def test_lines_are_followed_though_the_robot_went_another_way_than_expected(jump: tuple[float, float]) -> None:
    """It started or stopped at once: what was known of its lines stays known, and the new view is put right by it."""
    heights, rng = Heights(CALIBRATION), np.random.default_rng(SEED)
    list(drive(heights, TWO_HEIGHTS))
    assert heights.several
    before, names = POSES[-1], set(heights.state.tracks.name.tolist())
    known = np.count_nonzero(heights.state.tracks.level != UNKNOWN)
    pose = se2.compose(before, np.array([*jump, 0.0]))
    crossings, true = seen(TWO_HEIGHTS, pose, rng)
    placed = heights.look(crossings, np.zeros(3))
    assert placed is not None and len(placed) > 0.8 * len(crossings)
    near = np.min(np.hypot(*(placed.xy_base_m[:, None] - true[None]).transpose(2, 0, 1)), axis=1)
    print(f"seed {SEED}, {jump} m: {1e3 * np.max(near):.2f} mm off at most, {known} lines known")
    assert np.max(near) < 0.005
    heights.learn(Motion(Displacement(se2.between(before, pose)), 1e-6 * np.eye(3), len(placed), 0.0))
    assert len(set(heights.state.tracks.name.tolist()) - names) <= 1, "of all but one it is known which they are"


@pytest.mark.parametrize("too_long", [0.97, 1.03])
def test_a_way_along_one_axis_that_is_measured_badly_does_not_disown_its_lines(too_long: float) -> None:
    """All lines of that axis seem a little higher or lower then, those of the calibrated height as well; what the other
    axis showed while the robot drove along it says nothing of that."""
    heights, rng = Heights(CALIBRATION), np.random.default_rng(SEED)
    ceiling = [*grid(HIGH_M, -3.3, 12), *grid(HIGH_M - 0.4, -3.0, 12)]
    here, share = np.zeros(3), 1.0
    for step in 180 * [np.array([0.002, 0.012, 0.0])] + 160 * [np.array([0.012, 0.0, 0.0])]:
        along = step * ([1.0, 1.0, 1.0] if step[1] else [too_long, 1.0, 1.0])
        here = here + step
        in_view = [line for line in ceiling if abs(line[1] - here[line[0]]) < 1.3]
        crossings, _ = seen(in_view, here, rng)
        placed = heights.look(crossings, along)
        assert placed is not None
        heights.learn(Motion(Displacement(along), 1e-6 * np.eye(3), len(placed), 0.0))
        share = len(placed) / len(crossings)
    print(f"seed {SEED}, way {too_long}: {100 * share:.0f} % of the crossings are of known height")
    assert share > 0.9


def test_lines_of_another_view_are_not_followed() -> None:
    """Where no shift brings most lines together, those are new ones."""
    heights, rng = Heights(CALIBRATION), np.random.default_rng(SEED)
    list(drive(heights, TWO_HEIGHTS))
    names = set(heights.state.tracks.name.tolist())
    other = [(axis, float(at), HIGH_M) for axis in (0, 1) for at in rng.uniform(-1.5, 1.5, 5)]
    crossings, _ = seen(other, POSES[-1], rng)
    heights.look(crossings, np.zeros(3))
    heights.learn(Motion(Displacement(np.zeros(3)), 1e-6 * np.eye(3), len(crossings), 0.0))
    assert len(set(heights.state.tracks.name.tolist()) - names) >= 6
