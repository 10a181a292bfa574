"""Faint grooves of known places, drawn by their distance from a line; and pictures that hold none."""

import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Features
from ceilvo.daemon.vision.faint.direction import common_direction
from ceilvo.daemon.vision.faint.level_picture import LevelPicture
from ceilvo.daemon.vision.faint.line_search import find_faint
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.types import Array, LineKind, Lines

SEED = 11
TILE, NOISE = 120.0, 2.0
"""Grey levels."""
OFFSETS = {0: (-160.0, -48.0, 64.0, 176.0), 1: (-120.0, -8.0, 104.0)}
"""px of the level view along the normals of either axis."""
LEVEL, STILL = np.zeros(2), np.zeros(3)
Gray = NDArray[np.uint8]


def camera(kind: str = "pinhole") -> Calibration:
    return simulated_calibration(simulated_camera(kind))


def level_px(calibration: Calibration) -> Array:
    """(H, W, 2) where each pixel of the frame is in the level view."""
    view, cam = calibration.level_view, calibration.camera
    grid = np.stack(np.meshgrid(np.arange(cam.width_px), np.arange(cam.height_px)), -1).astype(np.float64)
    at = view.from_raw(grid.reshape(-1, 2)) - [cam.cx_px, cam.cy_px]
    return np.asarray(np.nan_to_num(at, nan=1e6).reshape(grid.shape))


def drawn(calibration: Calibration, psi: float, depth: float, width_px: float = 0.8, askew_rad: float = 0.0) -> Array:
    """A ceiling without noise: tiles with grooves so many grey levels deep; a bright bar where depth is below 0.

    Args:
        askew_rad: by which every second groove is turned, and the others the other way.
    """
    at = level_px(calibration)
    gray = np.full(at.shape[:2], TILE)
    for axis, offsets in OFFSETS.items():
        for k, offset in enumerate(offsets):
            angle = psi + axis * np.pi / 2 + (-1) ** k * askew_rad
            across = np.cos(angle) * at[..., 0] + np.sin(angle) * at[..., 1]
            gray -= depth * np.exp(-0.5 * ((across - offset) / width_px) ** 2)
    return gray


def lamps(calibration: Calibration, gray: Array) -> Array:
    """Two saturated lamps with a halo: one round, one with sides along no axis of the grid."""
    at = level_px(calibration)
    out = gray.copy()
    for centre, half, turn in (((-100.0, -60.0), (45.0, 45.0), None), ((120.0, 30.0), (60.0, 20.0), 0.5)):
        d = at - centre
        if turn is None:
            inside = np.hypot(d[..., 0], d[..., 1]) < half[0]
        else:
            u = np.cos(turn) * d[..., 0] + np.sin(turn) * d[..., 1]
            v = -np.sin(turn) * d[..., 0] + np.cos(turn) * d[..., 1]
            inside = (np.abs(u) < half[0]) & (np.abs(v) < half[1])
        out += 20.0 * np.exp(-np.hypot(d[..., 0], d[..., 1]) / 80.0)
        out[inside] = 300.0
    return out


def speckled(gray: Array, rng: np.random.Generator) -> Array:
    """Pinholes of mineral fibre: one pixel in eighty is darker."""
    return np.asarray(gray - 12.0 * (rng.random(gray.shape) < 1 / 80))


def photographed(gray: Array, rng: np.random.Generator) -> Gray:
    return np.asarray(np.clip(np.rint(gray + rng.normal(0.0, NOISE, gray.shape)), 0, 255), np.uint8)


def search(calibration: Calibration, gray: Gray, psi: float) -> Lines | None:
    picture = LevelPicture(calibration, 70.0)
    return find_faint(picture, *picture(gray), psi, LEVEL, Features(), None)


def along(lines: Lines, angle: float) -> Array:
    """Offsets of the lines whose normal is along +-angle, counted along it, sorted."""
    normal = lines.psi_rad + lines.axis * np.pi / 2
    sign = np.cos(normal - angle)
    return np.sort((lines.offset_px * np.sign(sign))[np.abs(sign) > 0.9])


@pytest.mark.parametrize("psi_deg", [0.0, 12.0, -44.0])
@pytest.mark.parametrize("depth", [3.0, -3.0])
def test_grooves_and_bars_of_three_grey_levels_are_where_they_were_drawn(psi_deg: float, depth: float) -> None:
    calibration, psi = camera(), np.radians(psi_deg)
    rng = np.random.default_rng(SEED)
    lines = search(calibration, photographed(drawn(calibration, psi, depth), rng), psi + np.radians(0.3))
    assert lines is not None
    print(f"seed {SEED}: psi off by {np.degrees(lines.psi_rad - psi):.4f} deg, tilt {np.degrees(lines.tilt_rad)} deg")
    assert (lines.kind == LineKind.GROOVE).all()
    assert abs(lines.psi_rad - psi) < np.radians(0.05)
    assert np.abs(lines.tilt_rad).max() < np.radians(0.25)
    for axis, offsets in OFFSETS.items():
        found = along(lines, psi + axis * np.pi / 2)
        print(axis, found)
        assert len(found) == len(offsets)
        assert np.abs(found - offsets).max() < 2.0


def test_seams_that_are_not_parallel_tell_no_tilt() -> None:
    """As between quilts and beams of a hall: any tilt fits them, so a robot of which nothing is known is level."""
    calibration = camera()
    rng = np.random.default_rng(SEED)
    silent = 0
    for _ in range(4):
        plain = drawn(calibration, 0.1, 4.0, askew_rad=np.radians(1.0))
        lines = search(calibration, photographed(plain, rng), 0.1)
        assert lines is not None
        print(f"seed {SEED}: {len(lines.axis)} lines, tilt {np.degrees(lines.tilt_rad)} deg", end=" ")
        print(f"+- {np.degrees(lines.tilt_sigma_rad)}, free +- {np.degrees(lines.free_tilt_sigma_rad)}")
        assert np.degrees(lines.tilt_sigma_rad).max() < 0.1
        assert np.abs(lines.tilt_rad / lines.tilt_sigma_rad).max() < 3.0
        if np.degrees(lines.free_tilt_sigma_rad).max() > 0.1:
            silent += 1
            assert np.abs(np.degrees(lines.tilt_rad)).max() < 1e-3
    assert silent >= 2, "most of the pictures are such as tell no tilt"


def looks(calibration: Calibration, plain: Array, count: int) -> Array:
    """(count,) directions, deg, that a robot sees that stands and knows it."""
    finder, rng = LineFinder(calibration, Features()), np.random.default_rng(SEED)
    found = [finder(photographed(plain, rng), STILL if k else None) for k in range(count)]
    return np.array([np.nan if lines is None else np.degrees(lines.psi_rad) for lines in found])


@pytest.mark.parametrize(("depth", "askew_deg"), [(12.0, 0.4), (14.0, 0.6), (10.0, 0.5)])
def test_the_direction_of_seams_that_are_not_parallel_does_not_jump(depth: float, askew_deg: float) -> None:
    """Two directions fit such seams as well, and noise alone had chosen between them from frame to frame."""
    calibration = camera()
    psi = looks(calibration, drawn(calibration, 0.1, depth, askew_rad=np.radians(askew_deg)), 16)
    print(f"seed {SEED}: {psi}")
    assert np.abs(psi - psi[0]).max() < 0.3


@pytest.mark.parametrize("turn_deg", [0.5, 3.0, 20.0])
def test_a_turn_that_nobody_told_is_seen(turn_deg: float) -> None:
    """The direction of the last frame is no more than a hint."""
    calibration, psi = camera(), 0.1
    finder, rng = LineFinder(calibration, Features()), np.random.default_rng(SEED)
    for k in range(4):
        finder(photographed(drawn(calibration, psi, 12.0), rng), STILL if k else None)
    turned = psi + np.radians(turn_deg)
    lines = finder(photographed(drawn(calibration, turned, 12.0), rng), STILL)
    assert lines is not None
    assert abs(lines.psi_rad - turned) < np.radians(0.1)


def test_what_varies_between_pictures_is_within_what_lines_claim() -> None:
    calibration, psi = camera(), 0.2
    plain = drawn(calibration, psi, 4.0)
    rng = np.random.default_rng(SEED)
    found = [search(calibration, photographed(plain, rng), psi) for _ in range(8)]
    good = [lines for lines in found if lines is not None and len(lines.axis) == 7]
    assert len(good) >= 7
    psis = np.array([lines.psi_rad for lines in good])
    claimed = float(np.median([lines.psi_sigma_rad for lines in good]))
    print(f"seed {SEED}: psi {np.degrees(psis.std()):.4f} deg, claimed {np.degrees(claimed):.4f}")
    assert psis.std() < 1.5 * claimed
    assert abs(psis.mean() - psi) < claimed


@pytest.mark.parametrize("what", ["noise", "lamps", "speckle", "lamps and speckle"])
def test_pictures_without_lines_give_at_most_one_false_line_in_ten(what: str) -> None:
    """A line needs a second one across or beside it to be reported, so false ones come in pairs or not at all."""
    calibration = camera()
    plain = np.full((calibration.camera.height_px, calibration.camera.width_px), TILE)
    bare = lamps(calibration, plain) if "lamps" in what else plain
    rng = np.random.default_rng(SEED)
    pictures = 10
    false = 0
    for k in range(pictures):
        gray = speckled(bare, rng) if "speckle" in what else bare
        lines = search(calibration, photographed(gray, rng), np.radians(18.0 * k - 90.0))
        false += 0 if lines is None else len(lines.axis)
    print(f"seed {SEED}, {what}: {false} lines in {pictures} pictures without any")
    assert false <= pictures // 10


@pytest.mark.parametrize("kind", ["pinhole", "fisheye"])
@pytest.mark.parametrize("psi_deg", [0.0, 17.3, -38.0])
def test_the_common_direction_is_found_from_nothing(kind: str, psi_deg: float) -> None:
    calibration, psi = camera(kind), np.radians(psi_deg)
    rng = np.random.default_rng(SEED)
    gray = photographed(lamps(calibration, drawn(calibration, psi, 4.0)), rng)
    picture = LevelPicture(calibration, 70.0)
    found = common_direction(*picture(gray))
    assert found is not None
    off = (found - psi + np.pi / 4) % (np.pi / 2) - np.pi / 4
    print(f"seed {SEED}: off by {np.degrees(off):.3f} deg")
    assert abs(off) < np.radians(0.7)


def test_noise_and_lamps_have_no_common_direction() -> None:
    calibration = camera()
    plain = np.full((calibration.camera.height_px, calibration.camera.width_px), TILE)
    rng = np.random.default_rng(SEED)
    picture = LevelPicture(calibration, 70.0)
    found = [common_direction(*picture(photographed(lamps(calibration, plain), rng))) for _ in range(5)]
    print(f"seed {SEED}: {found}")
    assert sum(f is not None for f in found) <= 1


def test_a_picture_of_one_grey_level_has_no_lines() -> None:
    calibration = camera()
    gray = np.full((calibration.camera.height_px, calibration.camera.width_px), 90, np.uint8)
    picture = LevelPicture(calibration, 70.0)
    assert common_direction(*picture(gray)) is None
    assert search(calibration, gray, 0.1) is None
