"""Oblong tiles, soft bars, grilles, strip lamps, footprints and glossy reflections, against their specification."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceilvo.bench.data import data_path
from ceilvo.bench.vision.textures import OFFICE_TEXTURE, PICTURED, found_ceilings
from ceilvo.calibration import Calibration
from ceilvo.errors import ConfigError, FileFormatError
from ceilvo.sim.ceiling.ceiling import RIM, SLOT, TILE, Ceiling
from ceilvo.sim.ceiling.layout import CrossingType
from ceilvo.sim.ceiling.pictured import Picture
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.gloss import Gloss
from ceilvo.sim.renderer import Renderer, RenderSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.types import LineKind

BARE = CeilingSpec(
    room_m=3.0, margin_m=1.0, texture=0.0, tile_spread=0.0, lamp_every=(0, 0), vents=0, spots=0, stains=0
)
CLEAN = RenderSpec(read_noise=0.0, shot_noise=0.0, vignetting=0.0)
POSE = np.array([1.5, 1.4, 0.3])


def test_oblong_tiles_have_their_pitch_along_each_axis_in_the_picture_too() -> None:
    c = Ceiling(replace(BARE, tile_y_m=1.2))
    for axis, pitch in ((0, 0.6), (1, 1.2)):
        np.testing.assert_allclose(np.diff(c.layout.grooves[axis]), pitch)
        dark = np.median(c.albedo, axis=axis) < 0.5
        begins = np.flatnonzero(np.diff(dark.astype(int)) == 1)
        assert abs(np.diff(begins).mean() * c.spec.texel_m - pitch) < 0.004
    xy, _ = c.true_crossings()
    assert len(xy) == len(c.layout.grooves[0]) * len(c.layout.grooves[1])


def test_lamps_fill_oblong_tiles_and_end_the_joints_between_them() -> None:
    c = Ceiling(CeilingSpec(room_m=4.0, margin_m=1.0, tile_y_m=1.2), seed=2)
    lamp = next(p for p in c.layout.lamps if p.recessed)
    x0, y0, x1, y1 = lamp.rect
    assert abs(x1 - x0 - (1.2 - 0.008)) < 1e-9
    assert abs(y1 - y0 - (1.2 - 0.008)) < 1e-9


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("nan")])
def test_a_tile_without_a_side_is_refused(wrong: float) -> None:
    with pytest.raises(ConfigError, match="tile_y_m"):
        CeilingSpec(tile_y_m=wrong)


def test_a_soft_bar_keeps_its_middle_and_its_light_and_loses_its_edges() -> None:
    bar = replace(BARE, groove_m=0.024, lip_m=0.0, groove_darker=0.15)
    hard, soft = (Ceiling(replace(bar, groove_soft_m=s)) for s in (0.0, 0.006))
    at = hard.layout.grooves[0][2]
    n = hard.spec.texel_m
    x = hard.layout.extent[0] + (np.arange(hard.albedo.shape[1]) + 0.5) * n
    near = np.abs(x - at) < 0.06
    slopes = []
    for c in (hard, soft):
        row = np.median(c.albedo, axis=0)[near].astype(float)
        ends = np.r_[:5, -5:0]
        dark = 1.0 - row / np.polyval(np.polyfit(x[near][ends], row[ends], 1), x[near])
        assert abs(dark.sum() * n - 0.15 * 0.024) < 1e-4
        assert abs((dark * x[near]).sum() / dark.sum() - at) < 3e-4
        slopes.append(np.abs(np.diff(dark)).max())
    assert slopes[1] < 0.6 * slopes[0]


def test_bright_bars_rise_before_they_fall() -> None:
    lines = Ceiling(replace(BARE, groove_m=0.024, lip_m=0.0, groove_darker=-0.08)).true_lines()
    vertical = lines.axis == 0
    at, kind = lines.segments[vertical][:, 0, 0], lines.kind[vertical]
    rising, falling = np.sort(at[kind == LineKind.RISING]), np.sort(at[kind == LineKind.FALLING])
    np.testing.assert_allclose(falling - rising, 0.024)


def test_a_grille_is_dark_between_bright_blades_and_its_crossings_are_listed() -> None:
    c = Ceiling(replace(BARE, grilles=3), seed=4)
    grilles = [p for p in c.layout.panels if p.kind == "grille"]
    assert len(grilles) == 3
    x0, y0, x1, y1 = grilles[0].inner
    first = c.layout.extent[0]
    rows, columns = (
        slice(int((lo - first) / 0.003) + 2, int((hi - first) / 0.003) - 2) for lo, hi in ((y0, y1), (x0, x1))
    )
    opening = c.albedo[rows, columns]
    assert abs(opening.min() - SLOT) < 1e-3
    assert abs(opening.max() - RIM) < 1e-3
    bright = (opening - SLOT).mean() / (RIM - SLOT)
    assert abs(bright - (1.0 - 0.8**2)) < 0.05, "blades of 10 mm every 50 mm, both ways"
    places = c.true_intersections()
    inside = (places > [x0, y0]).all(axis=1) & (places < [x1, y1]).all(axis=1)
    assert inside.sum() >= 9 * 22 * 10, "a blade has two edges and a middle"


def test_strip_lamps_stand_end_to_end_in_rows() -> None:
    c = Ceiling(replace(BARE, room_m=6.0, strip_lamps=True, lamp_every=(1, 2)), seed=4)
    rows = sorted({p.rect[1] for p in c.layout.lamps})
    np.testing.assert_allclose(np.diff(rows), 1.2)
    in_row = sorted(p.rect for p in c.layout.lamps if p.rect[1] == rows[0])
    assert len(in_row) >= 2
    for a, b in pairwise(in_row):
        assert abs(b[0] - a[2] - 0.04) < 1e-9


def finest(calibration: Calibration, ceiling: Ceiling, spec: RenderSpec) -> float:
    """Of what a camera of three times the resolution sees in the far corner, the share that pixels cannot show."""
    picture = Renderer(calibration, ceiling, replace(spec, psf_px=1.8)).render(POSE, np.random.default_rng(1))
    corner = picture[-160:, -160:].astype(float)
    window = np.outer(np.hanning(160), np.hanning(160))
    power = np.abs(np.fft.fft2((corner - corner.mean()) * window)) ** 2
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(160), np.fft.fftfreq(160)))
    return float(power[(wave > 1.0 / 6.0) & (wave < 0.3)].sum() / power[wave > 0.03].sum())


def test_fibre_seen_askance_does_not_alias_where_the_lens_blurs_as_a_lens_does() -> None:
    ceiling = Ceiling(replace(BARE, joints=False, fibre=1.0, texel_m=0.0015))
    fine = simulated_calibration(simulated_camera(width_px=1920, height_px=1440))
    spec = replace(CLEAN, gain=250.0)
    as_a_lens, alike = finest(fine, ceiling, replace(spec, footprint=True)), finest(fine, ceiling, spec)
    assert as_a_lens < 0.06
    assert as_a_lens < 0.6 * alike


def test_straight_above_the_footprint_changes_nothing() -> None:
    ceiling, cal = Ceiling(replace(BARE, joints=False, fibre=1.0)), simulated_calibration()
    a, b = (
        Renderer(cal, ceiling, replace(CLEAN, footprint=f)).render(POSE, np.random.default_rng(1)).astype(int)
        for f in (False, True)
    )
    middle = np.s_[225:255, 305:335]
    assert np.abs(a[middle] - b[middle]).max() <= 2
    assert b[:60, :60].std() < 0.9 * a[:60, :60].std()


@pytest.mark.parametrize(("carried", "share"), [(False, 1.4 / 3.6), (True, 1.0)])
def test_a_glint_slides_with_its_share_of_the_robots_way(carried: bool, share: float) -> None:
    """A mirror 2.2 m above the camera, a light 1.4 m below it."""
    cal = simulated_calibration(mount_xy_m=(0.0, 0.0), yaw_rad=0.0)
    glint = Gloss((0.3, 0.2) if carried else (1.8, 1.6), 1.4, 0.02, 4.0, carried)
    renderer = Renderer(cal, Ceiling(replace(BARE, joints=False)), replace(CLEAN, gloss=(glint,)))
    seen = []
    for x in (1.5, 1.7):
        picture = renderer.render(np.array([x, 1.4, 0.0]), np.random.default_rng(1))
        v, u = np.nonzero(picture > 240)
        ray = cal.camera.rays(np.array([[u.mean(), v.mean()]])) @ cal.camera_from_base
        seen.append(ray[0, :2] / ray[0, 2] * 2.2 + [x, 1.4])
    moved = seen[1] - seen[0]
    assert abs(moved[0] - share * 0.2) < 0.003
    assert abs(moved[1]) < 0.003


def test_a_light_in_the_ceiling_is_refused() -> None:
    with pytest.raises(ConfigError, match="below_m"):
        Gloss((0.0, 0.0), 0.0, 0.02, 1.0)


def drawn(path: Path) -> Picture:
    """Two by two tiles of 20 px with joints of 2 px at their sides; the last is dark but for a rim of 1 px."""
    grey = np.full((40, 40), 250, np.uint8)
    for at in (0, 20):
        grey[[at - 1, at], :] = grey[:, [at - 1, at]] = 200
    grey[22:38, 22:38] = 50
    assert cv2.imwrite(str(path), grey)
    return Picture(path, tiles=2, dark_every=2, dark_first=1, dark_inset=0.1)


def test_a_ceiling_may_be_a_picture_that_goes_on_beyond_its_sides(tmp_path: Path) -> None:
    joints = replace(BARE, grid_offset_m=(0.0, 0.0), groove_m=0.06, groove_darker=0.2, lip_m=0.0)
    c = Ceiling(replace(joints, picture=drawn(tmp_path / "ceiling.png")))
    assert np.max(c.albedo) == pytest.approx(TILE)

    def at(x: float, y: float) -> float:
        i, j = (int((v - c.layout.extent[0]) / c.spec.texel_m) for v in (x, y))
        return float(c.albedo[j, i] / TILE)

    xy, kinds = c.true_crossings()
    crossings = xy[kinds == CrossingType.CROSS]
    assert len(crossings) > 50
    inside = crossings[np.all((crossings > -0.9) & (crossings < 3.9), axis=1)]
    np.testing.assert_allclose([at(x, y) for x, y in inside], 200 / 250, atol=0.03)
    np.testing.assert_allclose([at(x + 0.3, y) for x, y in inside], 200 / 250, atol=0.03)
    panels = [p for p in c.layout.panels if p.kind == "dark"]
    assert len(panels) >= 4
    for p in panels:
        x, y = 0.5 * (p.rect[0] + p.rect[2]), 0.5 * (p.rect[1] + p.rect[3])
        assert at(x, y) == pytest.approx(50 / 250, abs=0.02)
        assert at(x + 0.6, y) == pytest.approx(1.0, abs=0.02)
    edges = c.layout.lines()
    assert np.count_nonzero((edges.axis == 0) & (edges.kind != LineKind.GROOVE)) >= 2 * len(panels)


def test_what_is_no_picture_is_said(tmp_path: Path) -> None:
    (tmp_path / "ceiling.png").write_text("nothing")
    picture = Picture(tmp_path / "ceiling.png", tiles=2, dark_every=2, dark_first=1, dark_inset=0.1)
    with pytest.raises(FileFormatError, match=r"ceiling\.png: cannot be read as a picture"):
        Ceiling(replace(BARE, grid_offset_m=(0.0, 0.0), picture=picture))
    with pytest.raises(ConfigError, match="grid_offset_m"):
        replace(BARE, picture=picture)


def test_the_picture_of_an_office_has_joints_and_panels_where_the_bench_says() -> None:
    found = [f for f in found_ceilings() if f.name == PICTURED]
    if not found:
        pytest.skip(f"{data_path(OFFICE_TEXTURE)} is absent; set CEILVO_DATA to the folder that holds it")
    c = Ceiling(found[0].ceiling)
    rows, columns = np.median(c.albedo, axis=1), np.median(c.albedo, axis=0)
    for axis, profile in ((0, columns), (1, rows)):
        dark = profile < 0.97 * np.median(profile)
        begins, ends = (np.flatnonzero(np.diff(dark.astype(int)) == s) + 1 for s in (1, -1))
        middles = [0.5 * (b + ends[ends > b][0]) for b in begins if np.any(ends > b)]
        at_m = c.layout.extent[axis] + np.array(middles) * c.spec.texel_m
        off = np.min(np.abs(at_m[:, None] - c.layout.grooves[axis][None]), axis=1)
        assert len(at_m) > 10 and np.max(off) < 0.004, f"joints are {np.round(off, 4)} m off"
    for p in (p for p in c.layout.panels if p.kind == "dark" and min(p.inner) > c.layout.extent[0] + 0.1):
        x0, y0, x1, y1 = ((np.array(p.inner) - c.layout.extent[0]) / c.spec.texel_m).round().astype(int)
        inside, around = c.albedo[y0 + 3 : y1 - 3, x0 + 3 : x1 - 3], c.albedo[y0 - 5 : y0 - 3, x0:x1]
        assert np.max(inside) < 0.5 * np.min(around)
