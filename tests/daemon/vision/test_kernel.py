"""The loops over edge points: the compiled kernel does what NumPy's does, and both what geometry says."""

from __future__ import annotations

import os
import subprocess
import sys
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel, LevelView
from ceilvo.daemon.vision import edge_tracking, kernel
from ceilvo.daemon.vision.kernel import reference
from ceilvo.daemon.vision.kernel.arguments import LOOKUP_STEP_PX, Grids, Look
from ceilvo.robust import median

pytestmark = pytest.mark.skipif(not kernel.COMPILED, reason="ceilvo was installed without a compiler")
BOTH = pytest.mark.parametrize("k", [reference, kernel], ids=["numpy", "compiled"])
NOISE = NoiseCurves((0.05,), (0.05,), sigma_theta_rad=0.02, r_min_m=0.0, r_max_m=6.0)
SEEDS = st.integers(0, 2**32 - 1)


def scene(seed: int, n: int = 500) -> tuple[Any, ...]:
    """Random points in four groups, with a line each."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-0.7, 0.7, (2, n)).astype(np.float32)
    a, b, c = np.sort(rng.integers(0, n + 1, 3)).tolist()
    return rng, x, y, (0, a, b, c, n)


def test_without_the_compiled_one_numpy_takes_over() -> None:
    code = (
        "import sys; sys.modules['ceilvo.daemon.vision.kernel.points'] = None\n"
        "from ceilvo.daemon.vision import kernel\n"
        "from ceilvo.daemon.vision.kernel import reference\n"
        "assert not kernel.COMPILED and kernel.settle is reference.settle"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=dict(os.environ))
    assert done.returncode == 0, done.stderr


def looks(rng: np.random.Generator, h: int, w: int) -> tuple[Any, ...]:
    """Arguments of follow() for a picture of noise: look-ups with holes, lines everywhere, also beyond the picture."""
    lookup = rng.normal(0, 300, ((h - 1) // 2 + 2, (w - 1) // 2 + 2, 2)).astype(np.float32)
    across, down = np.meshgrid(np.arange(-8.0, w + 8.0, 4.0), np.arange(-8.0, h + 8.0, 4.0))
    raw = (np.stack([across, down], -1) + rng.normal(0, 0.5, (*across.shape, 2))).astype(np.float32)
    raw[rng.random(across.shape) < 0.02] = np.nan
    grids = Grids(lookup, raw, (-8.0 - 0.5 * w, -8.0 - 0.5 * h), 4.0)
    angle = rng.uniform(-np.pi, np.pi, 8)
    start = rng.uniform(-w, 0, 8)
    lines = np.column_stack(
        [np.cos(angle), np.sin(angle), rng.uniform(-w / 2, w / 2, 8), start, start + rng.uniform(-5, 2 * w, 8)]
    )
    look = Look(
        float(rng.uniform(0.5, 20)), float(rng.uniform(0.5, 9)), float(rng.uniform(0, 300)), 0.5, bool(rng.integers(2))
    )
    return grids, lines, rng.normal(0, 0.03, 2), 50.0, look


@given(SEEDS)
@settings(max_examples=60, deadline=None)
def test_predicted_edges_are_followed_alike(seed: int) -> None:
    rng = np.random.default_rng(seed)
    h, w = int(rng.integers(3, 60)), int(rng.integers(3, 80))
    framed = rng.integers(0, 256, (h + 2, w + 2)).astype(np.uint8)
    args = looks(rng, h, w)
    x, y, line, looked = reference.follow(framed, *args)
    x_c, y_c, line_c, looked_c = kernel.follow(framed, *args)
    # a place that rounds to the next pixel in one of the two changes a point, no more
    assert np.abs(looked - looked_c).sum() <= 2
    assert abs(len(line) - len(line_c)) <= 2
    if len(line) and np.array_equal(line, line_c):
        assert np.mean(np.abs(x - x_c) < 1e-2) > 0.95
        assert np.mean(np.abs(y - y_c) < 1e-2) > 0.95


@BOTH
@pytest.mark.parametrize("rising", [True, False])
@pytest.mark.parametrize("off_px", [-3.0, 0.0, 2.5])
def test_a_predicted_edge_is_found_where_it_is(k: ModuleType, rising: bool, off_px: float) -> None:
    """A straight step in a distorted picture of a tilted robot, predicted a few pixels off."""
    camera = CameraModel("pinhole", 160, 120, 100.0, 100.0, 79.0, 61.0, (-0.15, 0.03, 0.0, 0.0))
    calibration = Calibration(
        camera, projection_matrix(camera, mount_rotation(0.0, 0.0, 0.0), (0.0, 0.0), 2.2), NOISE, "test"
    )
    focal = calibration.level_view.focal_px
    psi, offset, tilt = 0.4, 12.0, np.array([0.02, -0.03])
    grids = edge_tracking.look_ups(calibration, 70.0)
    uv = np.stack(np.meshgrid(np.arange(160.0), np.arange(120.0)), -1).reshape(-1, 2)
    seen = (calibration.level_view.from_raw(uv) - [camera.cx_px, camera.cy_px]) / focal
    rho, _ = reference.project(*seen.T.astype(np.float32), len(seen), psi, tilt)
    sign = 1.0 if rising else -1.0
    picture = (128 + sign * 80 * np.tanh((focal * rho - offset) / 1.2)).reshape(120, 160)
    framed = np.pad(np.rint(picture).astype(np.uint8), 1, "reflect")
    line = np.array([[sign * np.cos(psi), sign * np.sin(psi), sign * (offset + off_px), -60.0, 60.0]])
    x, y, index, looked = k.follow(framed, grids, line, tilt, focal, Look(2.0, 6.0, 20.0, 0.98, False))
    assert looked[0] > 40
    assert len(x) > 0.95 * looked[0]
    assert np.all(index == 0)
    found, _ = reference.project(x, y, len(x), psi, tilt)
    assert abs(float(np.mean(found)) * focal - offset) < 0.03
    assert np.abs(found * focal - offset).max() < 0.3
    line[:, :3] *= -1.0  # the other polarity is another edge
    assert len(k.follow(framed, grids, line, tilt, focal, Look(2.0, 6.0, 20.0, 0.98, False))[0]) == 0


@BOTH
def test_follow_refuses_what_is_too_small(k: ModuleType) -> None:
    framed = np.zeros((42, 62), np.uint8)
    grids, lines, tilt, focal, look = looks(np.random.default_rng(1), 40, 60)
    for picture, tables, how in (
        (framed[:4], grids, look),
        (framed, grids._replace(raw_of_level=grids.raw_of_level[:, :1].copy()), look),
        (framed, grids, look._replace(stride_px=0.0)),
    ):
        with pytest.raises(ValueError, match="expected at least 3 x 3, 2 x 2 and a stride above 0"):
            k.follow(picture, tables, lines, tilt, focal, how)


@BOTH
@pytest.mark.parametrize(("h", "w"), [(9, 12), (9, 13), (10, 12), (10, 13)])
def test_all_corners_of_a_pixel_must_be_in_the_look_up(k: ModuleType, h: int, w: int) -> None:
    """Even sizes need as many cells as odd ones: the last pixel inside the border is then on a cell's first corner."""
    need_h, need_w = (h - 2) // 2 + 2, (w - 2) // 2 + 2
    beyond = np.full((need_h + 1, need_w + 1, 2), np.nan, np.float32)
    beyond[:need_h, :need_w] = 1.0
    rng = np.random.default_rng(0)
    dx, dy = rng.integers(-900, 900, (2, h, w)).astype(np.int16)
    mask, rank = np.full((h, w), 255, np.uint8), np.zeros((h, w), np.uint16)
    framed = rng.integers(0, 256, (h + 2, w + 2)).astype(np.uint8)
    grids, *how = looks(rng, h, w)

    def run(lookup: NDArray[np.float32]) -> NDArray[np.float32]:
        k.follow(framed, grids._replace(lookup=lookup), *how)
        return np.asarray(k.level_points(mask, dx, dy, lookup, rank, 65535)[0])

    for lookup in (beyond, beyond[:need_h, :need_w].copy()):
        uv = run(lookup)
        assert len(uv) == (h - 2) * (w - 2) and np.isfinite(uv).all()
    for lookup in (beyond[:need_h, : need_w - 1].copy(), beyond[: need_h - 1, :need_w].copy()):
        with pytest.raises(ValueError, match="look-up of"):
            k.level_points(mask, dx, dy, lookup, rank, 65535)
        with pytest.raises(ValueError, match="look-up of"):
            k.follow(framed, grids._replace(lookup=lookup), *how)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_points_are_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    h, w = int(rng.integers(3, 40)), int(rng.integers(3, 60))
    mask = np.where(rng.random((h, w)) < 0.3, 255, 0).astype(np.uint8)
    dx, dy = rng.integers(-900, 900, (2, h, w)).astype(np.int16)
    lookup = rng.normal(0, 300, ((h - 1) // 2 + 2, (w - 1) // 2 + 2, 2)).astype(np.float32)
    rank = rng.integers(0, 65535, (h, w)).astype(np.uint16)
    limit = 65535 if seed % 2 else 30000
    uv, phi = reference.level_points(mask, dx, dy, lookup, rank, limit)
    uv_c, phi_c = kernel.level_points(mask, dx, dy, lookup, rank, limit)
    np.testing.assert_allclose(uv_c, uv, rtol=1e-4, atol=5e-3)
    assert np.all(np.abs((phi_c - phi + 180.0) % 360.0 - 180.0) < 0.05)
    assert np.all((phi_c >= 0) & (phi_c < 360))


@BOTH
def test_an_edge_is_placed_to_sub_pixel_in_the_level_view(k: ModuleType) -> None:
    camera = CameraModel("pinhole", 64, 48, 60.0, 60.0, 31.0, 24.0, (-0.1, 0.02, 0.0, 0.0))
    view = LevelView(camera, mount_rotation(0.3, 0.05, -0.08).T, 55.0)
    lookup = view.lookup(80.0, LOOKUP_STEP_PX)
    at = 20.3  # a step between two columns, as a parabola of the gradient
    x = np.arange(64)
    dx = np.tile(np.maximum(4000.0 - 900.0 * (x - at) ** 2, 0.0), (48, 1)).astype(np.int16)
    mask = np.zeros((48, 64), np.uint8)
    mask[:, 20] = 255
    uv, phi = k.level_points(mask, dx, np.zeros_like(dx), lookup, np.zeros((48, 64), np.uint16), 65535)
    rows = np.arange(1, 47)
    centre = [camera.cx_px, camera.cy_px]
    true = view.from_raw(np.column_stack([np.full(46, at), rows]).astype(float)) - centre
    along = view.from_raw(np.column_stack([np.full(46, at), rows + 0.01]).astype(float)) - centre - true
    np.testing.assert_allclose(uv, true, atol=0.03)
    # the gradient stands square on the edge, whatever the lens does to it, and points to the brighter side
    edge_deg = np.degrees(np.arctan2(along[:, 1], along[:, 0]))
    off = (phi - edge_deg + 90.0 + 180.0) % 360.0 - 180.0
    assert np.all(np.abs(off) < 0.5)


@given(SEEDS, st.floats(-45.0, 44.9), st.floats(1.0, 20.0))
@settings(max_examples=30, deadline=None)
def test_split_is_the_same(seed: int, psi: float, gate: float) -> None:
    rng = np.random.default_rng(seed)
    uv, phi = rng.normal(0, 200, (300, 2)).astype(np.float32), rng.uniform(0, 360, 300).astype(np.float32)
    x, y, ends = reference.split(uv, phi, psi, gate, 1 / 400)
    x_c, y_c, ends_c = kernel.split(uv, phi, psi, gate, 1 / 400)
    assert abs(ends[4] - ends_c[4]) <= 1  # a point on the gate itself
    if ends == ends_c:
        np.testing.assert_array_equal(x_c, x)
        np.testing.assert_array_equal(y_c, y)


@given(SEEDS, st.floats(-1.0, 1.0), st.integers(1, 5))
@settings(max_examples=30, deadline=None)
def test_votes_are_the_same(seed: int, angle: float, stride: int) -> None:
    _, x, y, ends = scene(seed)
    votes = reference.vote(x, y, ends, (angle, angle + 1.5), 200.0, 150, stride)
    votes_c = kernel.vote(x, y, ends, (angle, angle + 1.5), 200.0, 150, stride)
    assert votes.sum() == votes_c.sum()
    assert np.abs(votes - votes_c).sum() <= 4  # points on a bin's edge


@given(SEEDS, st.floats(-0.8, 0.8), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
@settings(max_examples=30, deadline=None)
def test_a_tilted_robots_rays_are_turned_back(seed: int, psi: float, a: float, b: float) -> None:
    _, x, y, ends = scene(seed)
    for k in (reference, kernel):
        rho, tangent = k.project(x, y, ends[2], psi, np.array([a, b]))
        level = np.column_stack([x, y, np.ones(len(x))]) + np.cross(
            [a, b, 0.0], np.column_stack([x, y, np.ones(len(x))])
        )
        level = level[:, :2] / level[:, 2:]
        first = level @ [np.cos(psi), np.sin(psi)]
        second = level @ [-np.sin(psi), np.cos(psi)]
        half = ends[2]
        np.testing.assert_allclose(rho, np.concatenate([first[:half], second[half:]]), atol=2e-6)
        np.testing.assert_allclose(tangent, np.concatenate([second[:half], -first[half:]]), atol=2e-6)


@given(SEEDS)
@settings(max_examples=40, deadline=None)
def test_points_get_the_nearest_line(seed: int) -> None:
    rng, x, y, ends = scene(seed)
    group = rng.integers(0, 4, int(rng.integers(0, 20)))
    offset = rng.uniform(-0.7, 0.7, len(group))
    rho, tangent = x.copy(), y.copy()
    for k in (reference, kernel):
        x1, y1, rho1, tangent1, line, ends1 = k.assign(x, y, rho, tangent, ends, offset, group, 0.1)
        expected = []
        for g in range(4):
            mine = np.flatnonzero(group == g)
            for i in range(ends[g], ends[g + 1]):
                if len(mine) and np.min(np.abs(rho[i] - offset[mine])) < 0.1:
                    expected.append((i, mine[int(np.argmin(np.abs(rho[i] - offset[mine])))]))
        at = np.array([i for i, _ in expected], np.int64)
        np.testing.assert_array_equal(line, [m for _, m in expected])
        for new, old in ((x1, x), (y1, y), (rho1, rho), (tangent1, tangent)):
            np.testing.assert_array_equal(new, old[at])
        assert ends1 == (0, *(int(np.searchsorted(at, e)) for e in ends[1:]))


@given(SEEDS, st.integers(0, 3))
@settings(max_examples=40, deadline=None)
def test_lines_in_one_place_share_its_points_between_them(seed: int, double: int) -> None:
    """Of lines at one offset any may get a point; which one is the same in both."""
    rng, x, y, ends = scene(seed)
    offset = np.repeat(rng.uniform(-0.7, 0.7, 3), 1 + double)
    group = np.repeat(rng.integers(0, 4), len(offset))
    of_numpy, compiled = (k.assign(x, y, x, y, ends, offset, group, 0.1) for k in (reference, kernel))
    np.testing.assert_array_equal(of_numpy[0], compiled[0])
    np.testing.assert_array_equal(offset[of_numpy[4]], offset[compiled[4]])


@given(SEEDS)
@settings(max_examples=60, deadline=None)
def test_peaks_are_maxima_of_three_bins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    votes, need = rng.integers(0, 9, (4, int(rng.integers(3, 60)))), float(rng.uniform(0.5, 20.0))
    for k in (reference, kernel):
        at, strength, ends = k.peaks(votes, need)
        expected = []
        for row in votes:
            three = [0, *(int(row[i - 1 : i + 2].sum()) for i in range(1, len(row) - 1)), 0]
            expected.append(
                [i for i in range(1, len(row) - 1) if three[i] >= need and three[i - 1] < three[i] >= three[i + 1]]
            )
        assert ends == (0, *np.cumsum([len(e) for e in expected]).tolist())
        where = [(g, i) for g, e in enumerate(expected) for i in e]
        assert strength.tolist() == [int(votes[g, i - 1 : i + 2].sum()) for g, i in where]
        moments = [(votes[g, i + 1] - votes[g, i - 1]) / votes[g, i - 1 : i + 2].sum() for g, i in where]
        middles = [i + 0.5 - votes.shape[1] // 2 for _, i in where]
        np.testing.assert_allclose(at, np.add(middles, moments), rtol=1e-12)


@given(SEEDS, st.floats(0.0, 89.9), st.integers(1, 4))
@settings(max_examples=60, deadline=None)
def test_the_direction_of_most_gradients_is_found(seed: int, deg: float, stride: int) -> None:
    rng = np.random.default_rng(seed)
    phi = np.append(rng.uniform(0, 360, 300), deg + 90.0 * rng.integers(0, 4, 2000) + rng.normal(0, 0.7, 2000)) % 360
    phi = rng.permutation(phi).astype(np.float32)
    of_numpy, compiled = (k.direction(phi, 4.0, stride) for k in (reference, kernel))
    assert abs(of_numpy - compiled) < 1e-9
    assert abs((compiled - deg + 45.0) % 90.0 - 45.0) < 0.2


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_offsets_are_the_means_of_level_points_and_extents_their_ends(seed: int) -> None:
    rng, x, y, ends = scene(seed)
    line, before = rng.integers(0, 7, len(x)).astype(np.int32), rng.uniform(-200, 200, 8)
    tilt = rng.normal(0, 0.03, 2)
    for k in (reference, kernel):
        rho, tangent = k.project(x, y, ends[2], 0.3, tilt)
        again, along, offset = k.settle(x, y, line, ends[2], 0.3, tilt, 400.0, before)
        np.testing.assert_array_equal(again, rho)
        np.testing.assert_array_equal(along, tangent)
        expected = [400.0 * rho[line == n].astype(float).mean() if n in line else before[n] for n in range(8)]
        np.testing.assert_allclose(offset, expected, rtol=1e-9, atol=1e-9)
        low, high = k.extents(tangent, line, 8)
        assert all(low[n] == tangent[line == n].min() and high[n] == tangent[line == n].max() for n in set(line))


@given(SEEDS, st.integers(1, 5))
@settings(max_examples=30, deadline=None)
def test_the_spread_is_the_median_distance(seed: int, stride: int) -> None:
    rng, rho, _, _ = scene(seed, int(np.random.default_rng(seed).integers(1, 60)))
    line, offset = rng.integers(0, 3, len(rho)).astype(np.int32), rng.uniform(-200, 200, 3)
    for k in (reference, kernel):
        found = k.spread(rho, line, offset, 400.0, stride)
        assert abs(found - median(np.abs(rho * 400.0 - offset[line])[::stride])) < 1e-4
        framed, samples = rng.integers(0, 256, (9, 11)).astype(np.uint8), rng.integers(0, 63, 20)
        slope = cv2.Sobel(framed, cv2.CV_16S, 1, 0)[1:-1, 1:-1].ravel()
        sizes = np.sort(np.abs(slope[samples]))
        assert k.slope_quartiles(framed, samples) == (sizes[5], sizes[10])
    assert kernel.slope_quartiles(framed, samples[:0]) == (0.0, 0.0)
    assert kernel.spread(rho[:0], line[:0], offset, 400.0, stride) == 0.0


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_crowds_are_counted(seed: int) -> None:
    xy = np.random.default_rng(seed).uniform(0, 1, (60, 2)).astype(np.float32)
    true = [np.count_nonzero(np.hypot(*(xy - p).T) < 0.2) - 1 for p in xy]
    for k in (reference, kernel):
        np.testing.assert_array_equal(k.crowd(xy, 0.2), true)


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30))
def test_median_is_one_of_the_middle_values(values: list[float]) -> None:
    array = np.array(values)
    ordered = np.sort(array)
    assert median(array) == ordered[len(values) // 2]
    assert median(np.zeros(0)) == 0.0
