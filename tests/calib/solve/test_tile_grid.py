"""Which grid: the spacing is decided rightly or refused, however periodic the rest of the ceiling is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.practice.virtual_bench import VirtualBench, random_rig
from ceilvo.calib.solve.grid import from_grid
from ceilvo.calib.solve.tile_grid import tile_index, tile_spacings
from ceilvo.calib.targets.ceiling_view import CeilingReader, GridView
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.rig import simulated_calibration
from ceilvo.sim.world import World, WorldSpec

Array = NDArray[np.float64]

CAMERA = CameraModel("pinhole", 640, 480, 410.0, 410.0, 319.5, 239.5, (0.0,) * 5)
TILE_M, HEIGHT_M = 0.6, 2.2


def views(ceiling: Array, count: int = 6, seed: int = 1) -> list[GridView]:
    """What a level camera at HEIGHT_M sees of points (N, 2) m, from places near the middle."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        pose = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-np.pi, np.pi)])
        xy = se2.transform(se2.inverse(pose), ceiling) / HEIGHT_M
        uv = CAMERA.pixels(np.column_stack([xy, np.ones(len(xy))])) + rng.normal(0, 0.05, xy.shape)
        seen = (uv > 0).all(axis=1) & (uv < [639, 479]).all(axis=1)
        psi = float(np.angle(np.exp(-4j * pose[2]))) / 4.0
        rays = CAMERA.rays(uv[seen])
        out.append(GridView(uv[seen], rays[:, :2] / rays[:, 2:], psi, 1e-4))
    return out


def grid(side_m: float = TILE_M, gone: float = 0.15, seed: int = 2) -> Array:
    k = np.arange(-8, 9) * side_m
    xy = np.stack(np.meshgrid(k + 0.11, k - 0.07), axis=-1).reshape(-1, 2)
    return np.asarray(xy[np.random.default_rng(seed).random(len(xy)) > gone])


def slats(count: int, seed: int = 3) -> Array:
    """Vents: slats every 5 cm, 0.5 m wide, here and there."""
    rng = np.random.default_rng(seed)
    one = np.stack(np.meshgrid([0.0, 0.5], np.arange(10) * 0.05), axis=-1).reshape(-1, 2)
    return np.concatenate([one + rng.uniform(-2.5, 2.5, 2) for _ in range(count)])


def found_height(seen: list[GridView], height_m: float | None = None) -> float:
    return from_grid(CAMERA, seen, TILE_M, (0.0, 0.0), None, height_m)[0].height_m


@settings(max_examples=12, deadline=None)
@given(side=st.floats(0.25, 0.9), gone=st.floats(0.0, 0.4), seed=st.integers(0, 1000))
def test_a_grid_with_holes_has_its_own_spacing(side: float, gone: float, seed: int) -> None:
    found = tile_spacings(views(grid(side, gone, seed), seed=seed))
    assert abs(found[0].tile_over_height / (side / HEIGHT_M) - 1) < 0.01
    assert len(found) < 2 or found[1].support < 0.8 * found[0].support


def test_slats_of_vents_do_not_pass_for_tiles() -> None:
    """Many crossings are on slats, whose spacing divides the tile's."""
    seen = views(np.concatenate([grid(), slats(3)]))
    joints = sum(len(tile_index(v, TILE_M / HEIGHT_M).used) for v in seen if tile_index(v, TILE_M / HEIGHT_M))
    assert joints < 0.75 * sum(len(v.xy) for v in seen)
    assert abs(found_height(seen) - HEIGHT_M) < 0.01


def test_evidence_names_the_runner_up() -> None:
    found, _ = from_grid(CAMERA, views(grid()), TILE_M, (0.0, 0.0))
    assert "100 % of the crossings are on it" in found.evidence
    assert "the next best, of a ceiling at 4.4" in found.evidence


def test_two_grids_that_fit_as_well_are_refused_until_a_tape_decides() -> None:
    """Tiles scored across the middle: as well a grid of half the size of which every other node is missing."""
    seen = views(np.concatenate([grid(gone=0.0), grid(gone=0.0) + np.array([0.0, 0.5 * TILE_M])]))
    with pytest.raises(CalibrationError, match="found two grids that fit") as e:
        found_height(seen)
    assert "2.20 m" in str(e.value) and "4.40 m" in str(e.value) and "pass --height-m" in str(e.value)
    assert abs(found_height(seen, 2.1) - HEIGHT_M) < 0.01
    assert abs(found_height(seen, 4.6) - 2.0 * HEIGHT_M) < 0.02


def test_no_grid_is_refused() -> None:
    rng = np.random.default_rng(4)
    with pytest.raises(CalibrationError, match=r"found no grid of square tiles of 0\.6 m: .* is the ceiling tiled"):
        found_height(views(rng.uniform(-3, 3, (300, 2))))


def test_a_height_that_no_grid_has_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"put the ceiling at 2\.20 m .* the tape says 3\.10 m, .* 0\.845 m"):
        found_height(views(grid()), 3.1)
    loose = views(np.random.default_rng(4).uniform(-3, 3, (300, 2)))
    with pytest.raises(CalibrationError, match=r"for a ceiling 3\.1 m above the camera, give or take a tenth"):
        found_height(loose, 3.1)


@pytest.mark.parametrize("seed", [16, 77])
def test_large_tiles_among_vents_are_found_or_refused(seed: int) -> None:
    """Pictures in which slats used to win, with ceilings 15 times as high."""
    rig = simulated_calibration(random_rig(seed).camera, ceiling_height_m=random_rig(seed).ceiling_height_m)
    bench = VirtualBench(rig, seed=seed)
    spec = CeilingSpec(tile_m=1.2, vents=40, lamp_every=(0, 0), grid_yaw_rad=0.3)
    bench._world = World(WorldSpec(seed=seed, ceiling=spec), rig)
    reader = CeilingReader(rig.camera)
    seen = [v for v in (reader(p.gray) for p in bench.places(4)) if v.ok]
    assert len(seen) >= 3
    try:
        found, _ = from_grid(rig.camera, seen, 1.2, reader.tilt_rad)
    except CalibrationError as e:
        assert "found no grid" in str(e) or "two grids" in str(e)
    else:
        assert abs(found.height_m / rig.ceiling_height_m - 1) < 0.02
