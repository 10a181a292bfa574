"""Which poses see the same tiles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.crossing_types import turned_type
from ceilvo.daemon.relocalisation.lattice import Lattice, rival_from_tracked, rival_poses
from ceilvo.se2 import inverse, rotation, transform, wrap
from ceilvo.types import Landmarks, Observations


def grid(axis_rad: float, tile: tuple[float, float] = (0.6, 0.6), count: int = 9) -> Landmarks:
    steps = np.array([(tile[0] * i, tile[1] * j) for i in range(count) for j in range(count)])
    xy = steps @ rotation(axis_rad).T + np.array([3.0, -2.0])
    n = len(xy)
    return Landmarks(np.arange(n), xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.full(n, 4), np.full(n, 9))


def view_from(landmarks: Landmarks, pose: np.ndarray, turns: int = 0) -> Observations:
    """Everything within 1.6 m, its heading known but for quarter turns."""
    near = np.hypot(*(landmarks.xy_map_m - pose[:2]).T) < 1.6
    n = int(near.sum())
    xy = transform(inverse(pose), landmarks.xy_map_m[near])
    heading = wrap(float(pose[2]) + 0.5 * np.pi * turns)
    kinds = turned_type(landmarks.crossing_type[near], -turns)
    return Observations(xy, np.full((n, 2), 1e-5), kinds, np.full(n, -1), heading, 1e-6)


@pytest.mark.parametrize("axis", [0.0, 0.4, -1.2])
@pytest.mark.parametrize("tile", [(0.6, 0.6), (0.3, 0.3), (1.25, 0.625)])
def test_periods_are_found_along_the_axes(axis: float, tile: tuple[float, float]) -> None:
    found = Lattice.of(grid(axis, tile), axis)
    assert found is not None
    assert np.allclose(found.tile_m, tile, atol=1e-6)
    shifts = found.shifts(2.0) @ rotation(axis)
    assert np.allclose(shifts / tile, np.round(shifts / tile), atol=1e-6)
    reach = [int(2.0 / t) for t in tile]
    every = [(i * tile[0], j * tile[1]) for i in range(-reach[0], reach[0] + 1) for j in range(-reach[1], reach[1] + 1)]
    assert len(shifts) == sum(0 < np.hypot(*s) <= 2.0 for s in every)


@pytest.mark.parametrize("axis", [0.0, 0.4, -1.2])
@pytest.mark.parametrize("tile", [(0.6, 0.6), (1.25, 0.625)])
def test_the_joint_near_a_point_is_the_nearest(axis: float, tile: tuple[float, float]) -> None:
    landmarks = grid(axis, tile)
    found = Lattice.of(landmarks, axis)
    assert found is not None
    inside = np.mean(landmarks.xy_map_m, axis=0) + np.random.default_rng(1).uniform(-1.0, 1.0, (20, 2))
    for xy in inside:
        nearest = landmarks.xy_map_m[np.argmin(np.hypot(*(landmarks.xy_map_m - xy).T))]
        assert np.allclose(found.joint_near(xy), nearest, atol=1e-6)


def test_two_edges_of_every_joint_are_no_period_and_a_few_points_are_none() -> None:
    one = grid(0.0)
    both = Landmarks(
        np.arange(2 * len(one)),
        np.concatenate([one.xy_map_m, one.xy_map_m + 0.03]),
        np.tile(np.eye(2), (2 * len(one), 1, 1)),
        np.full(2 * len(one), 4),
        np.full(2 * len(one), 4),
    )
    found = Lattice.of(both, 0.0)
    assert found is not None and np.allclose(found.tile_m, 0.6, atol=0.05)
    assert Lattice.of(one.of(np.arange(3)), 0.0) is None
    assert Lattice.of(one.of(np.arange(0)), 0.0) is None


@pytest.mark.parametrize("off", [(0.002, 0.002), (-0.3, 0.2)], ids=str)
def test_a_round_diffuser_that_has_more_crossings_than_the_tiles_in_view_does_not_move_the_lattice(
    off: tuple[float, float],
) -> None:
    """As under tiles of 1.25 m: four joints in view, and thirteen crossings like theirs along the diffuser's rings."""
    joints = grid(0.0, (1.25, 1.25))
    ring = 0.31 * np.array([(np.cos(a), np.sin(a)) for a in np.arange(13) * 0.29 + 0.13])
    xy = np.concatenate([joints.xy_map_m, np.array([3.0 + 3.6 * 1.25, -2.0 + 3.55 * 1.25]) + ring])
    n = len(xy)
    both = Landmarks(np.arange(n), xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.full(n, 4), np.full(n, 9))
    lattice = Lattice.of(both, 0.0)
    assert lattice is not None and np.allclose(lattice.tile_m, 1.25)
    true = np.array([7.6, 2.3, 0.0])
    view = view_from(both, true)
    assert len(view) == 13 + 4
    assert np.allclose(lattice.aligned(true + np.array([*off, 0.0]), view), true, atol=0.015)


@settings(max_examples=40, deadline=None)
@given(st.floats(-0.29, 0.29), st.floats(-0.29, 0.29), st.floats(-0.2, 0.2), st.integers(0, 3), st.floats(-0.7, 0.7))
def test_a_pose_that_is_off_by_a_part_of_a_tile_is_aligned(
    x: float, y: float, turn: float, q: int, axis: float
) -> None:
    """Whatever quarter turn the view was named by: the aligned pose sees every feature on a landmark."""
    landmarks = grid(axis)
    true = np.array([5.0, 0.5, axis + 0.1])
    true[:2] = landmarks.xy_map_m[40] + np.array([0.17, -0.08])
    lattice = Lattice.of(landmarks, axis)
    assert lattice is not None
    view = view_from(landmarks, true)
    there = lattice.aligned(true + np.array([x, y, turn]), view, q)
    assert abs(wrap(float(there[2]) - float(true[2]) + 0.5 * np.pi * q)) < 1e-9
    seen = transform(there, view.xy_base_m)
    apart = np.min(np.hypot(*(seen[:, None] - landmarks.xy_map_m).transpose(2, 0, 1)), axis=1)
    assert np.all(apart[np.hypot(*(seen - landmarks.xy_map_m[40]).T) < 1.2] < 1e-6)
    assert np.hypot(*(there - true - [x, y, 0])[:2]) <= 0.3 * np.sqrt(2.0) + 1e-9


@settings(max_examples=60, deadline=None)
@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3), st.integers(0, 3), st.floats(-9, 9))
def test_a_rival_goes_the_robots_way_in_its_own_place(x: float, y: float, theta: float, q: int, off: float) -> None:
    tracked = np.array([x, y, theta])
    rival = np.array([[x + off, y - 1.0, wrap(theta + 0.5 * np.pi * q)]])
    g = rival_from_tracked(rival, tracked)
    assert np.allclose(rival_poses(g, tracked)[:, :2], rival[:, :2], atol=1e-9)
    step = np.array([0.5, -0.2, 0.3])
    c, s = np.cos(theta), np.sin(theta)
    moved = np.array([x + c * 0.5 + s * 0.2, y + s * 0.5 - c * 0.2, theta + 0.3])
    c, s = np.cos(rival[0, 2]), np.sin(rival[0, 2])
    expected = np.array([rival[0, 0] + c * 0.5 + s * 0.2, rival[0, 1] + s * 0.5 - c * 0.2])
    assert np.allclose(rival_poses(g, moved)[0, :2], expected, atol=1e-9)
    assert abs(wrap(float(rival_poses(g, moved)[0, 2]) - float(rival[0, 2]) - step[2])) < 1e-9


def test_rivals_are_all_shifts_and_turns_but_not_the_pose_itself() -> None:
    landmarks = grid(0.0)
    pose = np.array([*landmarks.xy_map_m[40], 0.0])
    lattice = Lattice.of(landmarks, 0.0)
    assert lattice is not None
    straight = lattice.rivals(pose, view_from(landmarks, pose), 1.3, turned=False)
    assert len(straight) == len(lattice.shifts(1.3))
    assert np.min(np.hypot(*straight[:, :2].T)) > 0.5
    turned = rival_poses(lattice.rivals(pose, view_from(landmarks, pose), 1.3, turned=True), pose)
    assert len(turned) == 4 * len(straight) + 3
    assert len(np.unique(np.round(turned, 3), axis=0)) == len(turned)
