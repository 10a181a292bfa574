"""Plots of a lens whose errors are known: what is drawn where, read back from the drawing itself."""

from __future__ import annotations

from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from ceilvo.calib.record.drawing import Chart, Drawing, equal, shades, ticks
from ceilvo.calib.session import plots
from ceilvo.calib.solve.intrinsics import Intrinsics, Shot
from ceilvo.camera import CameraModel

CAMERA = CameraModel("pinhole", 640, 480, 400.0, 410.0, 322.0, 238.0, (-0.1, 0.02, 0.001, -0.001, 0.0))
SPREAD = np.array([0.2, 0.2, 0.1, 0.1, 3e-4, 8e-4, 2e-5, 2e-5, 5e-4])


def fit(views: int = 3, seed: int = 5) -> Intrinsics:
    rng = np.random.default_rng(seed)
    board = np.array([(0.03 * i, 0.03 * j, 0.0) for j in range(4) for i in range(5)])
    shots = tuple(Shot(f"v{k}", board, rng.uniform((20, 20), (620, 460), (20, 2))) for k in range(views))
    residual = rng.normal(0.0, 0.05, (20 * views, 2))
    uv = np.concatenate([s.uv_px for s in shots])
    pose = np.column_stack([rng.normal(0, 0.3, (views, 3)), np.tile((0.0, 0.0, 0.5), (views, 1))])
    rms = float(np.sqrt((residual**2).mean()))
    each = np.full(views, rms)
    return Intrinsics(CAMERA, "pinhole", SPREAD, np.diag(SPREAD**2), rms, shots, (), each, residual, uv, pose)


def shapes(svg: str, kind: str) -> list[ElementTree.Element]:
    return [e for e in ElementTree.fromstring(svg) if e.tag.endswith("}" + kind)]


def texts(svg: str) -> list[str]:
    return [e.text or "" for e in shapes(svg, "text")]


def test_every_corner_is_a_dot_of_its_views_colour() -> None:
    lens = fit()
    svg = plots.reprojection(lens)
    dots = shapes(svg, "circle")
    assert len(dots) == 60 and [d.get("fill") for d in dots] == np.repeat(shades([0, 1, 2], 0, 2), 20).tolist()
    at = np.array([(float(d.get("cx", "")), float(d.get("cy", ""))) for d in dots])
    # one scale across and down, y up: the dots are the residuals but for a shift and a factor
    factor = np.ptp(at[:, 0]) / np.ptp(lens.residual_px[:, 0])
    drawn = (at - at.mean(axis=0)) * (1, -1) / factor
    assert np.abs(drawn - (lens.residual_px - lens.residual_px.mean(axis=0))).max() < 0.1 / factor
    assert "residual in u [px]" in texts(svg)


def test_vectors_are_as_many_times_as_long_as_they_say() -> None:
    lens = fit()
    svg = plots.vectors(lens)
    (said,) = (t for t in texts(svg) if "times as long" in t)
    factor = float(said.split()[2])
    lines = [e.get("points", "") for e in shapes(svg, "polyline") if e.get("stroke") in shades([0, 1, 2], 0, 2)]
    ends = np.array([[tuple(map(float, p.split(","))) for p in line.split()] for line in lines])
    assert len(ends) == 60
    scale = 322.0 / 480.0
    length = np.hypot(*(ends[:, 1] - ends[:, 0]).T) / scale
    assert np.abs(length - factor * np.hypot(*lens.residual_px.T)).max() < 0.5


def test_uncertainty_is_what_drawing_lenses_from_the_covariance_gives() -> None:
    """Against lenses drawn at random, the turn between each and the first taken out by least squares over the rays."""
    grid = (8, 6)
    sigma = plots.uncertainty_px(CAMERA, np.diag(SPREAD**2), grid)
    rng = np.random.default_rng(11)
    u, v = np.meshgrid((np.arange(8) + 0.5) * 80.0, (np.arange(6) + 0.5) * 80.0)
    rays = CAMERA.rays(np.column_stack([u.ravel(), v.ravel()]))
    at = CAMERA.pixels(rays)
    off = []
    for _ in range(400):
        p = np.array([CAMERA.fx_px, CAMERA.fy_px, CAMERA.cx_px, CAMERA.cy_px, *CAMERA.distortion]) + rng.normal(
            0, SPREAD
        )
        lens = replace(CAMERA, fx_px=p[0], fy_px=p[1], cx_px=p[2], cy_px=p[3], distortion=tuple(p[4:].tolist()))
        turn = np.zeros(3)
        for _ in range(4):
            base = lens.pixels(rays @ cv2.Rodrigues(turn)[0].T)
            j = [(lens.pixels(rays @ cv2.Rodrigues(turn + 1e-6 * e)[0].T) - base).ravel() / 1e-6 for e in np.eye(3)]
            turn = turn - np.linalg.lstsq(np.column_stack(j), (base - at).ravel(), rcond=None)[0]
        off.append(lens.pixels(rays @ cv2.Rodrigues(turn)[0].T) - at)
    drawn = np.array(off)
    found = [np.sqrt(np.linalg.eigvalsh(np.cov(drawn[:, k].T, bias=True))[-1]) for k in range(len(rays))]
    assert np.abs(sigma.ravel() / found - 1.0).max() < 0.2  # 400 drawings: 3.5 % each, the larger axis is biased up
    assert sigma[0, 0] > 2.0 * sigma[2, 3]


def test_where_a_lens_sees_nothing_there_is_no_sigma() -> None:
    narrow = replace(CAMERA, kind="fisheye", fx_px=60.0, fy_px=60.0, distortion=(0.0, 0.0, 0.0, 0.0))
    sigma = plots.uncertainty_px(narrow, np.diag(SPREAD[:8] ** 2), (16, 12))
    assert sigma.shape == (12, 16) and (sigma[np.isfinite(sigma)] >= 0).all() and np.isfinite(sigma[6, 8])


@pytest.mark.parametrize("plot", [plots.reprojection, plots.vectors, plots.poses, plots.uncertainty])
def test_plots_stand_within_their_frame(plot: object) -> None:
    svg = plot(fit())  # type: ignore[operator]
    root = ElementTree.fromstring(svg)
    w, h = float(root.get("width", "")), float(root.get("height", ""))
    for e in root:
        for pair in (e.get("points") or "").split():
            x, y = map(float, pair.split(","))
            assert -1 <= x <= w + 1 and -1 <= y <= h + 1


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-0.13, 0.13), (0.0, 2.5), (-7.0, 641.0), (0.0, 1e-5)])
def test_ticks_are_round_and_some(low: float, high: float) -> None:
    found = ticks(low, high)
    assert 3 <= len(found) <= 11 and all(low - 1e-9 <= t <= high + 1e-9 for t in found)
    assert np.ptp(np.diff(found)) < 1e-9 * (high - low) + 1e-15


def test_a_metre_is_as_long_across_as_up() -> None:
    x, y = equal([(0, 0), (4, 1)], 450.0, 322.0)
    chart = Chart(Drawing(640, 400), (70, 28, 520, 350), x, y)
    a, b, c = chart.at([(0, 0), (1, 0), (0, 1)])
    assert b[0] - a[0] == pytest.approx(a[1] - c[1])
