"""Rendered frames against the calibration's forward geometry (never the rays that the renderer uses) and statistics."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.errors import ConfigError
from ceilvo.sim.ceiling.ceiling import Ceiling
from ceilvo.sim.ceiling.layout import CrossingType
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.renderer import Renderer, RenderSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera

CLEAN = RenderSpec(read_noise=0.0, shot_noise=0.0, vignetting=0.0)
PLAIN = CeilingSpec(texture=0.0, stains=0, spots=0, tile_spread=0.0)


@pytest.fixture(scope="module")
def plain() -> Ceiling:
    return Ceiling(PLAIN, seed=2)


@pytest.fixture(scope="module")
def office() -> Ceiling:
    return Ceiling(CeilingSpec(), seed=2)


def rng() -> np.random.Generator:
    return np.random.default_rng(11)


def pixels(
    cal: Calibration, xy_map: np.ndarray, pose: np.ndarray, tilt: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """(N, 2) where map points of the ceiling appear, from the mounting and the lens' forward model."""
    base = se2.transform(se2.inverse(pose), xy_map)
    up = np.column_stack([base - cal.mount_xy_m, np.full(len(base), cal.ceiling_height_m)])
    body_from_level = cv2.Rodrigues(-np.array([*tilt, 0.0]))[0]
    return cal.camera.pixels(up @ body_from_level.T @ cal.camera_from_base.T)


def groove_error_m(
    image: np.ndarray, cal: Calibration, at: np.ndarray, axis: int, pose: np.ndarray, tilt: tuple[float, float]
) -> float:
    """How far from a groove's arm (axis 0: x = const) that begins at a crossing `at` its darkness is centred."""
    across = np.arange(-0.03, 0.0301, 0.001)
    along = np.arange(0.08, 0.20, 0.01)
    grid = np.stack(np.meshgrid(across, along), axis=-1)
    points = at + (grid if axis == 0 else grid[..., ::-1])
    uv = pixels(cal, points.reshape(-1, 2), pose, tilt).astype(np.float32).reshape(*points.shape)
    value = cv2.remap(image.astype(np.float32), uv, None, cv2.INTER_LINEAR).mean(axis=0)
    edge = np.abs(across) > 0.022
    dark = np.polyval(np.polyfit(across[edge], value[edge], 1), across) - value
    return float((dark * across).sum() / dark.sum())


CASES = {
    "usual": (simulated_calibration(), (0.0, 0.0)),
    "tilted robot": (simulated_calibration(), (0.03, -0.025)),
    "tilted mount": (simulated_calibration(roll_rad=0.05, pitch_rad=-0.08, yaw_rad=0.7), (0.0, 0.0)),
    "fisheye": (simulated_calibration(simulated_camera("fisheye", 1280, 960), mount_xy_m=(-0.1, 0.2)), (0.01, 0.02)),
}


@pytest.mark.parametrize("case", CASES)
def test_grooves_appear_where_the_lens_puts_them(case: str) -> None:
    cal, tilt = CASES[case]
    plain = Ceiling(replace(PLAIN, lamp_every=(0, 0), vents=0))  # nothing beside a groove that shifts its darkness
    renderer = Renderer(cal, plain, CLEAN)
    w, h = cal.camera.width_px, cal.camera.height_px
    xy, kind = plain.true_crossings()
    errors = []
    for pose in np.array([[1.6, 1.0, 0.0], [3.9, 2.3, 1.9], [2.2, 2.7, -2.6]]):
        image = renderer.render(pose, rng(), tilt)
        for crossing in xy[kind == CrossingType.CROSS]:
            for axis in (0, 1):
                arm = crossing + 0.14 * np.eye(2)[1 - axis]
                u, v = pixels(cal, arm[None], pose, tilt)[0]
                if np.hypot(*(arm - pose[:2])) < 2.0 and 25 < u < w - 25 and 25 < v < h - 25:
                    errors.append(groove_error_m(image, cal, crossing, axis, pose, tilt))
    px_m = cal.metres_per_px
    error_px = np.abs(errors) / px_m
    assert len(errors) > 60
    assert abs(np.mean(errors)) / px_m < 0.003, "the picture is shifted"
    assert np.median(error_px) < 0.01
    assert error_px.max() < 0.08, error_px.max()


def shift_px(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F)
    return cv2.phaseCorrelate(a.astype(np.float32), b.astype(np.float32), window)[0]


def pinhole() -> Calibration:
    cam = replace(simulated_camera(), distortion=(), fy_px=410.3)
    return simulated_calibration(cam, mount_xy_m=(0.0, 0.0), yaw_rad=0.0)


def test_driving_forward_moves_the_scene_backward(office: Ceiling) -> None:
    """With the camera's axes along base's, image x is forward and image y is left."""
    renderer = Renderer(pinhole(), office, CLEAN)
    before = renderer.render((2.5, 2.5, 0.0), rng()).astype(int)
    step_m = 6 * 2.2 / 410.3  # six pixels, so that the pictures can be compared without interpolation
    ahead = renderer.render((2.5 + step_m, 2.5, 0.0), rng()).astype(int)
    assert np.abs(ahead[:, :-6] - before[:, 6:]).max() <= 1
    left = renderer.render((2.5, 2.5 + step_m, 0.0), rng()).astype(int)
    assert np.abs(left[:-6] - before[6:]).max() <= 1


def test_turning_left_turns_the_scene_right(office: Ceiling) -> None:
    """A point straight ahead moves to the robot's right, which is towards smaller image y."""
    cal = pinhole()
    renderer = Renderer(cal, office, CLEAN)
    angle = 0.05
    image, turned = (renderer.render((2.5, 2.5, a), rng()) for a in (0.0, angle))
    centre = (cal.camera.cx_px, cal.camera.cy_px)
    back = cv2.getRotationMatrix2D(centre, np.degrees(angle), 1.0)  # OpenCV: positive brings x towards smaller y
    expected = cv2.warpAffine(image, back, image.shape[::-1])
    crop = (slice(60, -60), slice(60, -60))
    near = np.abs(expected[crop].astype(float) - turned[crop]).mean()
    wrong = np.abs(image[crop].astype(float) - turned[crop]).mean()
    assert near < 0.25 * wrong


def test_nose_up_sees_more_of_what_is_behind(office: Ceiling) -> None:
    """Pitch about +y is nose down: the lens leans forward and the scene moves backward; roll about +x moves it left."""
    renderer = Renderer(pinhole(), office, CLEAN)
    level = renderer.render((2.5, 2.5, 0.0), rng())[100:-100, 150:-150]
    dx, _ = shift_px(level, renderer.render((2.5, 2.5, 0.0), rng(), (0.0, 0.01))[100:-100, 150:-150])
    assert abs(dx + 410.3 * 0.01) < 0.8
    _, dy = shift_px(level, renderer.render((2.5, 2.5, 0.0), rng(), (0.01, 0.0))[100:-100, 150:-150])
    assert abs(dy - 410.3 * 0.01) < 0.8


def test_lit_lamps_saturate_and_unlit_ones_do_not(plain: Ceiling) -> None:
    cal = simulated_calibration()
    lamp = plain.layout.lamps[0]
    centre = np.array([[0.5 * (lamp.rect[0] + lamp.rect[2]), 0.5 * (lamp.rect[1] + lamp.rect[3])]])
    pose = np.array([*centre[0] + 0.4, 0.5])
    u, v = pixels(cal, centre, pose)[0].round().astype(int)
    spot = (slice(v - 5, v + 6), slice(u - 5, u + 6))
    bright = Renderer(cal, plain).render(pose, rng())
    dark = Renderer(cal, plain, RenderSpec(lit=())).render(pose, rng())
    assert (bright[spot] == 255).all()
    assert dark[spot].max() < 100
    assert 60 < np.median(bright) < 170
    assert np.median(dark) < 0.5 * np.median(bright)


def test_noise_has_the_variance_that_was_asked_for(plain: Ceiling) -> None:
    spec = RenderSpec(read_noise=1.5, shot_noise=0.03)
    cal, pose, gen = simulated_calibration(), (2.5, 2.5, 0.3), rng()
    mean = Renderer(cal, plain, replace(spec, read_noise=0.0, shot_noise=0.0)).render(pose, gen).astype(float)
    renderer = Renderer(cal, plain, spec)
    frames = np.array([renderer.render(pose, gen) for _ in range(24)]).astype(float)
    for lo, hi in ((40, 70), (90, 110), (120, 140)):
        where = (mean > lo) & (mean < hi)
        if where.sum() < 2000:
            continue
        expected = 1.5**2 + 0.03 * mean[where].mean() + 1 / 12  # and rounding to grey levels
        assert abs(frames[:, where].var(axis=0, ddof=1).mean() / expected - 1) < 0.05
        assert abs((frames.mean(axis=0) - mean)[where].mean()) < 0.05
    neighbours = (frames[0] - mean)[:, :-1] * (frames[0] - mean)[:, 1:]
    assert abs(neighbours[mean[:, :-1] < 200].mean()) < 0.1, "noise of neighbours goes together"
    between = (frames[0] - mean) * (frames[1] - mean)
    assert abs(between[mean < 200].mean()) < 0.1, "noise of successive frames goes together"


def test_corners_are_darker_by_the_vignetting(plain: Ceiling) -> None:
    cal, pose = simulated_calibration(), (2.5, 2.5, 0.0)
    flat = Renderer(cal, plain, CLEAN).render(pose, rng()).astype(float)
    shaded = Renderer(cal, plain, replace(CLEAN, vignetting=0.4)).render(pose, rng()).astype(float)
    ok = (flat > 50) & (flat < 250)
    ratio = np.where(ok, shaded / np.maximum(flat, 1), np.nan)
    x, y = np.arange(640) - cal.camera.cx_px, np.arange(480) - cal.camera.cy_px
    r2 = (x[None, :] ** 2 + y[:, None] ** 2) / (cal.camera.cx_px**2 + (479 - cal.camera.cy_px) ** 2)
    assert np.nanmax(np.abs(ratio - (1 - 0.4 * r2))) < 0.025


def test_motion_blur_smears_along_the_motion_only(office: Ceiling) -> None:
    renderer = Renderer(pinhole(), office, CLEAN)
    steps = np.linspace(-0.015, 0.015, 9)
    poses = np.column_stack([2.5 + steps, np.full(9, 2.5), np.zeros(9)])
    sharp = renderer.render((2.5, 2.5, 0.0), rng()).astype(float)
    smeared = renderer.render(poses, rng()).astype(float)
    energy = [np.abs(np.diff(im, axis=1)).sum() / np.abs(np.diff(im, axis=0)).sum() for im in (sharp, smeared)]
    assert energy[1] < 0.6 * energy[0]
    each = np.array([renderer.render(p, rng()) for p in poses]).astype(float)
    unsaturated = each.max(axis=0) < 255
    assert np.abs(each.mean(axis=0) - smeared)[unsaturated].max() <= 1.0


def test_flicker_follows_the_lamps_and_averages_over_a_mains_period(plain: Ceiling) -> None:
    cal, pose = simulated_calibration(), (2.5, 2.5, 0.0)
    spec = replace(CLEAN, flicker_hz=100.0, flicker_depth=0.5)
    renderer = Renderer(cal, plain, spec)
    levels = [float(np.median(renderer.render(pose, rng(), t_s=t))) for t in (0.0, 0.0025, 0.005, 0.0075)]
    assert levels[1] > levels[0] + 15 and levels[3] < levels[0] - 15
    assert abs(levels[2] - levels[0]) <= 1
    steady = Renderer(cal, plain, replace(spec, exposure_s=0.01))
    means = [float(np.median(steady.render(pose, rng(), t_s=t))) for t in (0.0, 0.0025, 0.0075)]
    assert max(means) - min(means) <= 1


def test_same_generator_same_bytes_and_a_frame_of_its_own(plain: Ceiling) -> None:
    renderer = Renderer(simulated_calibration(), plain)
    a = renderer.render((2.0, 2.0, 0.1), rng())
    kept = a.copy()
    other = renderer.render((2.1, 2.0, 0.1), rng())
    np.testing.assert_array_equal(a, kept)
    assert not np.array_equal(a, other)
    np.testing.assert_array_equal(renderer.render((2.0, 2.0, 0.1), rng()), kept)
    assert a.dtype == np.uint8 and a.shape == (480, 640)


@pytest.mark.parametrize("bad", [{"gain": -1.0}, {"flicker_depth": 1.5}, {"vignetting": -0.1}, {"sub_poses": 0}])
def test_impossible_sensors_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(bad))):
        RenderSpec(**bad)  # type: ignore[arg-type]
