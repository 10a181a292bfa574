"""Beams, lower ceilings and slopes of the simulator against projections by the camera model alone."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.surroundings.boxes import Box
from ceilvo.sim.surroundings.surroundings import SurroundingsSpec
from ceilvo.sim.world import World, WorldSpec

POSE = np.array([2.3, 1.7, 0.4])
TILT = np.array([0.03, -0.02])
HIGH_M = 2.2
PLAIN = CeilingSpec(texture=0.0, tile_spread=0.0, stains=0, vents=0, spots=0, lamp_every=(0, 0))
QUIET = RenderSpec(read_noise=0.0, shot_noise=0.0, vignetting=0.0)


def world(*boxes: Box, ceiling: CeilingSpec = PLAIN) -> World:
    return World(WorldSpec(ceiling=ceiling, render=QUIET, surroundings=SurroundingsSpec(boxes=boxes)))


def pixel(w: World, xyz_map: tuple[float, float, float], tilt: np.ndarray) -> np.ndarray:
    """Raw pixel of a point in map with its height above the camera."""
    base = se2.transform(se2.inverse(POSE), np.array([xyz_map[:2]]))[0] - w.calibration.mount_xy_m
    ray = cv2.Rodrigues(np.array([*tilt, 0.0]))[0].T @ np.array([*base, xyz_map[2]])
    return w.calibration.camera.pixels((w.calibration.camera_from_base @ ray)[None])[0]


def along(picture: np.ndarray, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places between two pixels, and the picture's values there."""
    at = start + np.linspace(0.0, 1.0, 801)[:, None] * (end - start)
    return at, cv2.remap(picture.astype(np.float32), at.astype(np.float32)[None], None, cv2.INTER_LINEAR)[0]


@pytest.mark.parametrize("tilt", [np.zeros(2), TILT])
def test_a_box_hides_from_its_upper_near_edge_to_its_lower_far_edge(tilt: np.ndarray) -> None:
    """The camera stands beside it and sees a side: that begins at the ceiling."""
    w = world(Box((3.0, 1.7), (0.4, 2.0), 1.8, HIGH_M))
    hidden = w.renderer.occlusion(POSE, tilt)
    for edge_x, high_m, out in ((2.8, HIGH_M, -0.06), (3.2, 1.8, 0.1)):
        for y in (1.5, 1.9):
            inside, outside = (pixel(w, (edge_x + d, y, high_m), tilt) for d in (-out, out))
            at, values = along(hidden, inside, outside)
            assert values[0] > 0.99
            assert values[-1] < 0.01
            found = at[int(np.argmin(np.abs(values - 0.5)))]
            assert np.hypot(*(found - pixel(w, (edge_x, y, high_m), tilt))) < 0.5


def test_the_nearer_of_two_boxes_is_seen_whatever_their_order() -> None:
    low, high = Box((2.4, 1.7), (0.4, 2.0), 1.5, 1.7, 0.9), Box((2.4, 1.7), (2.0, 0.4), 1.9, HIGH_M, 0.2)
    one, other = (world(*boxes).renderer.render(POSE, np.random.default_rng(1)) for boxes in ((low, high), (high, low)))
    u, v = np.rint(pixel(world(), (2.4, 1.7, 1.5), np.zeros(2))).astype(int)
    assert one[v, u] > 100
    assert abs(int(one[v, u]) - int(other[v, u])) < 10


@pytest.mark.parametrize("tilt", [np.zeros(2), TILT])
def test_the_joints_of_a_lower_ceiling_are_where_its_height_puts_them(tilt: np.ndarray) -> None:
    box = Box((2.4, 1.8), (3.0, 3.0), 1.8, HIGH_M, 0.74, 0.6)
    w = world(box)
    picture = w.renderer.render(POSE, np.random.default_rng(1), tilt)
    for x in box.joints()[0][1:3]:
        start, end = (pixel(w, (float(x) + d, 2.0, 1.8), tilt) for d in (-0.04, 0.04))
        at, values = along(picture, start, end)
        dark = np.clip(np.median(values) - 12.0 - values, 0.0, None)
        found = np.average(at, axis=0, weights=dark)
        assert np.hypot(*(found - pixel(w, (float(x), 2.0, 1.8), tilt))) < 0.4


@pytest.mark.parametrize("tilt", [np.zeros(2), TILT])
def test_the_joints_of_a_sloping_ceiling_are_where_its_plane_puts_them(tilt: np.ndarray) -> None:
    slope = (0.08, -0.05)
    w = world(ceiling=CeilingSpec(**{**PLAIN.__dict__, "slope": slope}))
    picture = w.renderer.render(POSE, np.random.default_rng(1), tilt)
    middle = 0.5 * w.ceiling.spec.room_m

    def point(x: float, y: float) -> np.ndarray:
        high_m = HIGH_M + slope[0] * (x - middle) + slope[1] * (y - middle)
        return pixel(w, (x, y, high_m), tilt)

    joints = [x for x in w.ceiling.layout.grooves[0] if abs(x - POSE[0]) < 1.0]
    y = float(w.ceiling.layout.grooves[1][4]) + 0.3
    for x in joints:
        at, values = along(picture, point(x - 0.1, y), point(x + 0.1, y))
        dark = np.clip(np.median(values) - 8.0 - values, 0.0, None)
        assert np.hypot(*(np.average(at, axis=0, weights=dark) - point(x, y))) < 0.4
    assert len(joints) >= 3
