"""Boards against the statistics that they are drawn from, and those against the picture they were measured in."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ceilvo.bench.data import data_path
from ceilvo.bench.vision.textures import OFFICE_TEXTURE
from ceilvo.sim.ceiling import board
from ceilvo.sim.ceiling.ceiling import Ceiling
from ceilvo.sim.ceiling.spec import CeilingSpec

TEXEL_M = 0.003
SIZE = (1000, 800)
TILE_PX, TILE_MM, BORDER_PX = 256, 600.0, 16


def octaves_rms(faces: np.ndarray, mm: float) -> np.ndarray:
    """(7,) rms of each octave of board.CLOUDS_MM in square faces (N, n, n) about 1, whose samples are mm apart."""
    n = faces.shape[1]
    window = np.outer(np.hanning(n), np.hanning(n))
    power = np.mean([np.abs(np.fft.fft2((f - 1.0) * window)) ** 2 for f in faces], 0) / (window**2).sum() / n**2
    wave_mm = mm / np.maximum(np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n))), 1e-9)
    bounds = zip(board.CLOUDS_MM, board.CLOUDS_MM[1:], strict=False)
    return np.array([np.sqrt(power[(wave_mm >= lo) & (wave_mm < hi)].sum()) for lo, hi in bounds])


@pytest.fixture(scope="module")
def photographed() -> np.ndarray:
    """(N, 224, 224) faces of plain tiles in linear light, each about 1."""
    file = data_path(OFFICE_TEXTURE)
    if not file.exists():
        pytest.skip(f"{file} is not there: a CC0 picture of a ceiling, not part of this repository")
    coded = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE).astype(float) / 255.0
    light = np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)
    tiles = light.reshape(16, TILE_PX, 16, TILE_PX).swapaxes(1, 2).reshape(-1, TILE_PX, TILE_PX)
    faces = tiles[:, BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
    plain = faces[faces.mean(axis=(1, 2)) > 0.5]  # the others are lamps
    return plain / plain.mean(axis=(1, 2), keepdims=True)


def test_the_pictures_clouds_are_those_in_the_code_and_it_has_no_holes(photographed: np.ndarray) -> None:
    assert len(photographed) == 240
    measured = octaves_rms(photographed, TILE_MM / TILE_PX)
    np.testing.assert_allclose(measured, board.CLOUDS_RMS, rtol=0.05)
    fine = np.array([f - cv2.GaussianBlur(f, (0, 0), 3.0) for f in photographed])
    assert abs(fine.std() - 0.0020) < 0.0003
    assert fine.min() > -0.01, "a pinhole of 1 mm would be 10 % darker than its surroundings"


def test_drawn_clouds_have_the_octaves_of_the_picture() -> None:
    texel_mm = 2.34375
    clouds = board.clouds((1792, 1344), 1e-3 * texel_mm, np.random.default_rng(5)).astype(float)
    faces = clouds.reshape(6, 224, 8, 224).swapaxes(1, 2).reshape(-1, 224, 224)
    drawn = octaves_rms(faces / faces.mean(axis=(1, 2), keepdims=True), texel_mm)
    np.testing.assert_allclose(drawn, board.CLOUDS_RMS, rtol=0.5)
    assert (np.diff(drawn[:-1]) > 0).all(), "the longest octave is cut off by the tile and its mean"
    assert abs(np.sqrt((drawn**2).sum()) - np.linalg.norm(board.CLOUDS_RMS)) < 0.25 * np.linalg.norm(board.CLOUDS_RMS)


def test_holes_cover_the_area_that_their_numbers_and_sizes_make() -> None:
    covered = board.holes(SIZE, TEXEL_M, 1.0, np.random.default_rng(6))
    of_pinholes = board.PINHOLES_PER_M2 * 0.25 * np.pi * board.PINHOLE_M**2 * np.exp(2.0 * 0.3**2)
    least, most = 0.003, 0.030
    mean_m = least + board.FISSURE_LENGTH_M * (
        np.exp(-least / board.FISSURE_LENGTH_M) - np.exp(-most / board.FISSURE_LENGTH_M)
    )
    of_fissures = board.FISSURES_PER_M2 * board.FISSURE_WIDTH_M * (mean_m + 0.0005)
    assert abs(covered.mean() - of_pinholes - of_fissures) < 0.05 * (of_pinholes + of_fissures)
    twice = board.holes(SIZE, TEXEL_M, 2.0, np.random.default_rng(6))
    assert abs(twice.mean() / covered.mean() - 2.0) < 0.1


def test_what_a_hole_takes_does_not_depend_on_where_it_lies_nor_on_the_texel() -> None:
    mean, rms = [], []
    for texel_m in (0.0015, 0.003):
        n = round(1.5 / texel_m)
        face = board.holes((n, n), texel_m, 1.0, np.random.default_rng(7)).astype(float)
        mean.append(face.mean())
        as_a_pixel = cv2.GaussianBlur(face, (0, 0), 0.0045 / texel_m)
        rms.append(as_a_pixel.std())
    assert abs(mean[0] - mean[1]) < 0.03 * mean[1]
    assert abs(rms[0] - rms[1]) < 0.10 * rms[1]


def test_fissures_run_along_the_boards_and_seeds_repeat() -> None:
    a, b, other = (board.fibre(SIZE, TEXEL_M, 1.0, np.random.default_rng(s)) for s in (8, 8, 9))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, other)
    dark = 1.0 - a.astype(float)
    dark -= dark.mean()
    along, across = (dark[:, 2:] * dark[:, :-2]).mean(), (dark[2:] * dark[:-2]).mean()
    assert along > 1.3 * across > 0


def test_painted_bars_have_no_holes() -> None:
    spec = CeilingSpec(
        room_m=2.0,
        margin_m=0.5,
        fibre=1.0,
        groove_m=0.024,
        lip_m=0.0,
        groove_darker=-0.1,
        tile_spread=0.0,
        lamp_every=(0, 0),
        vents=0,
        spots=0,
        stains=0,
    )
    c = Ceiling(spec)
    x0 = c.layout.extent[0]
    column = int((c.layout.grooves[0][2] - x0) / spec.texel_m)
    on_bar, on_tile = c.albedo[:, column], c.albedo[:, column + 60]
    assert on_bar.min() > 0.8 * np.median(on_bar)
    assert on_tile.min() < 0.8 * np.median(on_tile)
    assert np.median(on_bar) > 1.05 * np.median(on_tile)


def test_each_slat_of_wood_has_its_own_brightness_and_grain_runs_along_it() -> None:
    slat = np.arange(SIZE[0]) // 40
    face = board.wood(slat, SIZE, TEXEL_M, np.random.default_rng(10)).astype(float)
    middles = face.reshape(SIZE[1], -1, 40).mean(axis=(0, 2))
    assert 0.07 < middles.std() < 0.25
    assert np.abs(np.diff(face, axis=0)).mean() < 0.2 * np.abs(np.diff(face, axis=1)).mean()
