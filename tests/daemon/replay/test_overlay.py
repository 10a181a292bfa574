"""Pictures: what is drawn lies where the geometry says."""

from __future__ import annotations

import itertools
import math
from typing import Any

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.daemon.replay.drawing.overlay import (
    DARK,
    GREEN,
    ORANGE,
    SKY,
    VERMILION,
    WHITE,
    YELLOW,
    Colour,
    PanelView,
    draw_overlay,
    draw_particles_panel,
    line_in_raw,
    previous_pixels,
    side_by_side,
    tilted,
)
from ceilvo.types import Crossings, LineKind, Lines, Motion

CAMERA = CameraModel("pinhole", 320, 240, 200.0, 205.0, 155.0, 125.0, (-0.25, 0.06, 0.0005, -0.0004))
FISHEYE = CameraModel("fisheye", 320, 240, 110.0, 110.0, 160.0, 120.0, (0.01, -0.004, 0.0, 0.0))
BLACK = np.zeros((240, 320), np.uint8)


def calibration(camera: CameraModel = CAMERA) -> Calibration:
    rotation = mount_rotation(0.2, 0.03, -0.02)
    noise = NoiseCurves((0.01,), (0.01,), 0.01, 0.0, 2.0)
    return Calibration(camera, projection_matrix(camera, rotation, (0.1, 0.05), 2.2), noise)


def lines(
    offsets: Any, axes: Any, psi: float = 0.3, tilt: Any = (0.0, 0.0), kind: int = 0, span: float = 90.0
) -> Lines:
    """Lines that are supported densely over +-span pixels along themselves."""
    along = np.linspace(-span, span, 361)
    points, owner = [], []
    for k, (offset, axis) in enumerate(zip(offsets, axes, strict=True)):
        angle = psi + 0.5 * np.pi * axis
        n, a = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        points.append(offset * n + along[:, None] * a)
        owner.append(np.full(len(along), k))
    count = len(offsets)
    return Lines(
        psi_rad=psi,
        psi_sigma_rad=0.001,
        axis=np.array(axes, np.int64),
        offset_px=np.array(offsets, np.float64),
        sigma_px=np.full(count, 0.1),
        kind=np.full(count, kind, np.int64),
        support=np.full(count, len(along), np.int64),
        tilt_rad=np.array(tilt, np.float64),
        tilt_sigma_rad=np.full(2, 0.001),
        free_tilt_rad=np.array(tilt, np.float64),
        free_tilt_sigma_rad=np.full(2, 0.001),
        points=np.concatenate(points),
        point_line=np.concatenate(owner).astype(np.int64),
    )


def crossings(cal: Calibration, xy_base_m: Any, kind: Any, tilt: Any = (0.0, 0.0)) -> Crossings:
    xy = np.asarray(xy_base_m, np.float64)
    uv = np.column_stack([xy, np.ones(len(xy))]) @ cal.level_from_ceiling.T
    return Crossings(
        uv_px=uv[:, :2] / uv[:, 2:],
        xy_base_m=xy,
        cov_base_m2=np.tile(np.eye(2) * 1e-6, (len(xy), 1, 1)),
        crossing_type=np.array(kind, np.int64),
        psi_rad=0.3,
        psi_sigma_rad=0.001,
        tilt_rad=np.array(tilt, np.float64),
        tilt_sigma_rad=np.full(2, 0.001),
        common_cov_m2=np.zeros((2, 2)),
    )


def painted(image: Any, colour: Colour, tolerance: int = 60) -> Any:
    """(K, 2) pixels x, y close to a colour."""
    near = np.abs(image.astype(int) - np.array(colour)).max(axis=2) < tolerance
    return np.argwhere(near)[:, ::-1].astype(float)


def distance_to_curve(points: Any, curve: Any) -> Any:
    dense = np.concatenate([np.linspace(a, b, 20) for a, b in itertools.pairwise(curve)])
    dense = dense[np.all(np.isfinite(dense), axis=1)]
    return np.array([np.hypot(*(dense - p).T).min() for p in points])


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE], ids=["pinhole", "fisheye"])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_line_is_painted_where_the_lens_puts_it(camera: CameraModel, axis: int) -> None:
    """Independent truth: the level line itself, point by point through the camera model."""
    view = calibration(camera).level_view
    made = lines([30.0], [axis], span=140.0)
    image = draw_overlay(BLACK, made, None, view)
    image[:24] = 0  # the caption
    found = painted(image, (ORANGE, SKY)[axis])
    centre = np.array([camera.cx_px, camera.cy_px])
    truth = view.to_raw(made.points + centre)
    below = found[np.hypot(*(found - view.to_raw(centre[None])[0]).T) > 65.0]  # away from the direction arrows
    assert len(below) > 60
    assert distance_to_curve(below, truth).max() < 1.8
    truth = truth[np.hypot(*(truth - view.to_raw(centre[None])[0]).T) > 66.0]
    inside = truth[(truth[:, 0] > 2) & (truth[:, 0] < 317) & (truth[:, 1] > 26) & (truth[:, 1] < 237)]
    missing = np.array([np.hypot(*(found - p).T).min() for p in inside])
    assert np.quantile(missing, 0.9) < 1.5


def test_the_curve_bends_as_the_lens_does() -> None:
    view = calibration().level_view
    raw = line_in_raw(lines([60.0], [0], span=110.0), 0, view)
    raw = raw[np.all(np.isfinite(raw), axis=1)]
    chord = raw[-1] - raw[0]
    normal = np.array([-chord[1], chord[0]]) / np.hypot(*chord)
    assert np.abs((raw - raw[0]) @ normal).max() > 2.0
    back = view.from_raw(raw) - [CAMERA.cx_px, CAMERA.cy_px]
    assert np.abs(back @ [np.cos(0.3), np.sin(0.3)] - 60.0).max() < 0.01


def test_gaps_in_the_support_are_left_out() -> None:
    made = lines([30.0], [0])
    along = made.points @ [-np.sin(0.3), np.cos(0.3)]
    keep = np.abs(along) > 40.0
    gap = lines([30.0], [0])
    broken = Lines(**{**{f: getattr(gap, f) for f in Lines.__slots__}, "points": made.points[keep],
                      "point_line": made.point_line[keep]})  # fmt: skip
    whole, holed = (line_in_raw(m, 0, calibration().level_view) for m in (made, broken))
    assert np.all(np.isfinite(whole))
    lost = ~np.isfinite(holed[:, 0])
    assert 0.3 < lost.mean() < 0.45
    assert np.isfinite(holed[[0, -1]]).all()


def test_a_line_without_points_never_folds_back() -> None:
    """At the edge of the lens model the polynomial turns around; nothing may be drawn from there on."""
    view = calibration().level_view
    made = lines([30.0], [0])
    bare = Lines(**{**{f: getattr(made, f) for f in Lines.__slots__}, "points": np.zeros((0, 2)),
                    "point_line": np.zeros(0, np.int64)})  # fmt: skip
    raw = line_in_raw(bare, 0, view)
    raw = raw[np.all(np.isfinite(raw), axis=1)]
    back = view.from_raw(raw) - [CAMERA.cx_px, CAMERA.cy_px]
    assert len(raw) > 20
    assert np.abs(back @ [np.cos(0.3), np.sin(0.3)] - 30.0).max() < 1.5


def test_tilt_is_the_inverse_of_what_the_line_fit_does() -> None:
    """The fit levels a point by x + b, y - a over 1 + a y - b x; drawing must undo exactly that."""
    view = calibration().level_view
    a, b = 0.02, -0.03
    rng = np.random.default_rng(3)
    seen = rng.uniform(-0.5, 0.5, size=(50, 2))
    x, y = seen.T
    level = np.column_stack([x + b, y - a]) / (1.0 + a * y - b * x)[:, None]
    centre = np.array([CAMERA.cx_px, CAMERA.cy_px])
    back = tilted(level * view.focal_px + centre, np.array([a, b]), view)
    assert np.abs(back - (seen * view.focal_px + centre)).max() < 1e-9


def test_tilt_moves_the_drawn_line() -> None:
    view = calibration().level_view
    flat, rolled = (line_in_raw(lines([30.0], [0], tilt=t), 0, view) for t in ((0.0, 0.0), (0.0, 0.05)))
    shift = np.hypot(*(flat - rolled).T)
    assert abs(float(np.nanmedian(shift)) - 0.05 * view.focal_px) < 3.0


@pytest.mark.parametrize(
    ("kind", "colour"), [(4, GREEN), (3, YELLOW), (0, VERMILION)], ids=["disc", "triangle", "square"]
)
def test_crossings_are_painted_by_kind_on_their_pixel(kind: int, colour: Colour) -> None:
    cal = calibration()
    made = crossings(cal, [[0.4, 0.3]], [kind], tilt=(0.02, 0.01))
    image = draw_overlay(BLACK, None, made, cal.level_view)
    found = painted(image, colour)
    expected = cal.level_view.to_raw(tilted(made.uv_px, made.tilt_rad, cal.level_view))[0]
    assert 15 < len(found) < 80
    assert np.hypot(*(found.mean(axis=0) - expected)) < 0.6


def test_enlarging_keeps_the_place() -> None:
    cal = calibration()
    made = crossings(cal, [[0.4, 0.3]], [4])
    small = painted(draw_overlay(BLACK, None, made, cal.level_view), GREEN).mean(axis=0)
    large_image = draw_overlay(BLACK, None, made, cal.level_view, scale=3)
    large = painted(large_image, GREEN).mean(axis=0)
    assert large_image.shape == (720, 960, 3)
    assert np.abs(large - ((small + 0.5) * 3 - 0.5)).max() < 1.0


def test_previous_pixels_are_those_of_the_same_ceiling_point() -> None:
    """Independent truth: a point fixed to the room, projected from two poses of the robot."""
    cal = calibration()
    point = np.array([[1.2, 0.9]])
    before, now = np.array([0.5, 0.4, 0.3]), np.array([0.55, 0.43, 0.35])
    in_before, in_now = (se2.transform(se2.inverse(p), point) for p in (before, now))
    made = crossings(cal, in_now, [4])
    motion = Motion(se2.between(before, now), np.eye(3), 10, 0.0)
    expected = np.column_stack([in_before, [1.0]]) @ cal.level_from_ceiling.T
    assert np.abs(previous_pixels(made, motion, cal) - expected[:, :2] / expected[:, 2:]).max() < 1e-9


def test_nothing_found_is_the_frame_itself_only_darker() -> None:
    gray = np.arange(240 * 320, dtype=np.uint32).reshape(240, 320).astype(np.uint8)
    image = draw_overlay(gray, None, None, calibration().level_view)
    assert image.dtype == np.uint8
    assert np.all(image[..., 0] == image[..., 2])
    assert np.all(image[..., 0] <= gray)
    empty = crossings(calibration(), np.zeros((0, 2)), [])
    assert np.array_equal(image, draw_overlay(gray, None, empty, calibration().level_view, np.zeros((0, 2))))


def test_points_beyond_the_lens_are_left_out() -> None:
    cal = calibration()
    made = crossings(cal, [[500.0, 0.0], [0.4, 0.3]], [4, 4])
    previous = np.array([[np.nan, 0.0], [1e12, -1e12]])
    found = painted(draw_overlay(BLACK, None, made, cal.level_view, previous), GREEN)
    assert 15 < len(found) < 80


def test_the_panel_has_x_right_and_y_up() -> None:
    view = PanelView((-1.0, -1.0, 1.0, 1.0), 201)
    assert view.pixels(np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])) == pytest.approx(
        np.array([[100.0, 100.0], [150.25, 100.0], [100.0, 49.75]])
    )


def test_particles_landmarks_and_robot_are_where_they_should_be() -> None:
    bounds = (-2.0, -2.0, 2.0, 2.0)
    image = draw_particles_panel(
        poses=np.array([[1.0, 1.0, 0.0]]),
        weights=None,
        landmarks_xy_m=np.array([[-1.0, 0.5]]),
        landmarks_cov_m2=np.array([np.diag([0.2**2, 0.1**2])]),
        pose=np.array([-1.0, -1.0, 0.5 * math.pi]),
        path_xy_m=np.array([[-1.0, -1.5], [-1.0, -1.0]]),
        bounds_m=bounds,
        size_px=400,
    )
    view = PanelView(bounds, 400)
    particle = painted(image, ORANGE)
    assert np.hypot(*(particle - view.pixels(np.array([1.0, 1.0]))[0]).T).max() < 10
    green = painted(image, GREEN, 40)
    middle = view.pixels(np.array([-1.0, 0.5]))[0]
    assert np.abs(green.mean(axis=0) - middle).max() < 1.5
    assert abs(np.ptp(green[:, 0]) / view.px_per_m - 0.8) < 0.05  # 2 sigma to either side
    assert abs(np.ptp(green[:, 1]) / view.px_per_m - 0.4) < 0.05
    image[370:, :100] = DARK  # the caption
    robot = painted(image, WHITE, 80)
    tip = robot[robot[:, 1].argmin()]
    assert np.abs(tip - (view.pixels(np.array([-1.0, -1.0]))[0] - [0, 11])).max() < 2.5  # points up: heading +90 deg


def test_heavy_particles_are_brighter() -> None:
    poses = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]])
    image = draw_particles_panel(
        poses,
        np.array([0.01, 0.99]),
        np.zeros((0, 2)),
        None,
        np.array([0.0, 0.8, 0.0]),
        bounds_m=(-1, -1, 1, 1),
        size_px=200,
    )
    left, right = (int(image[90:110, s].max()) for s in (slice(40, 65), slice(140, 165)))
    assert left < right


def test_values_that_are_not_numbers_do_not_stop_the_picture() -> None:
    nan = float("nan")
    image = draw_particles_panel(
        np.array([[nan, 0.0, 0.0], [0.0, 0.0, nan]]),
        np.array([nan, 1.0]),
        np.array([[nan, nan]]),
        np.full((1, 2, 2), 1.0),
        np.array([nan, nan, nan]),
    )
    assert image.shape == (480, 480, 3)


def test_side_by_side() -> None:
    left, right = np.zeros((240, 320, 3), np.uint8), np.full((480, 480, 3), 255, np.uint8)
    both = side_by_side(left, right, {"left": "frame", "right": "filter"})
    assert both.shape == (240, 560, 3)
    assert np.all(both[100:, 330:] == 255)
    ok, _ = cv2.imencode(".png", both)
    assert ok


def test_grooves_are_thicker_than_edges() -> None:
    view = calibration().level_view
    counts = [
        len(painted(draw_overlay(BLACK, lines([30.0], [0], kind=k), None, view), ORANGE))
        for k in (LineKind.GROOVE, LineKind.RISING)
    ]
    assert counts[0] > 1.2 * counts[1]
