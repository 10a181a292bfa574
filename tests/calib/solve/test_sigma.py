"""calib sigma: curves, bands, order, CSV files and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.commands.sigma import errors_of_csv
from ceilvo.calib.solve.sigma import Errors, circles, fit
from ceilvo.calib.study.__main__ import experiment
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]


@pytest.mark.parametrize("k", [(0.004,), (0.003, 0.004), (0.003, 0.0, 0.002)], ids=str)
def test_the_generating_curve_is_inside_the_band(k: tuple[float, ...]) -> None:
    """The quick version of `python -m ceilvo.calib.study sigma`, which demands 90 of 100."""
    hits = 0
    for seed in range(20):
        curve = fit(experiment(k, seed, 4, 20), seed).x
        hits += curve.covers(np.asarray(polyval(curve.r_m, k), np.float64))
    assert hits >= 17


def test_a_wrong_curve_is_outside_the_band() -> None:
    curve = fit(experiment((0.003, 0.004), 1, 6, 60), 1).x
    assert not curve.covers(np.full(len(curve.r_m), 0.02))
    assert not curve.covers(np.asarray(polyval(curve.r_m, (0.011, -0.004)), np.float64))


def test_a_clear_slope_is_found_and_a_constant_is_left_one() -> None:
    assert fit(experiment((0.001, 0.01), 3, 5, 40), 3).x.order >= 1
    orders = [fit(experiment((0.004,), s, 5, 40), s).x.order for s in range(10)]
    assert orders.count(0) >= 8


def test_sigma_theta_and_its_own_sigma() -> None:
    noise = fit(experiment((0.004,), 5, 4, 100), 5)
    assert abs(noise.sigma_theta_rad - 0.002) < 3 * noise.sigma_theta_sigma < 0.0004


def test_circles_are_told_apart_and_spread_radii_are_cut_into_shares() -> None:
    r = np.repeat([0.5, 1.0, 1.5], 8) + np.random.default_rng(1).normal(0, 0.005, 24)
    assert np.bincount(circles(r)).tolist() == [8, 8, 8]
    spread = np.random.default_rng(2).uniform(0.2, 2.0, 100)
    assert len(np.bincount(circles(spread))) == 8


def errors(circles_: int, each: int) -> Errors:
    return experiment((0.004,), 1, circles_, each)


@pytest.mark.parametrize(
    ("e", "reason"),
    [
        (errors(2, 20), "2 circles, at least 3"),
        (errors(4, 4), "4 samples at r = .* at least 6"),
        (Errors(errors(4, 20).r_m, np.zeros(80), np.ones(80), np.ones(80)), "errors in x that are zero"),
        (Errors(errors(4, 20).r_m, np.ones(80), np.ones(80), np.ones(3)), "3 headings"),
    ],
    ids=["circles", "samples", "zero", "headings"],
)
def test_too_little_is_refused(e: Errors, reason: str) -> None:
    with pytest.raises(CalibrationError, match=reason):
        fit(e)


def poses(seed: int = 1) -> Array:
    """x, y, theta measured about a feature at the origin; seen x, y, theta with the errors added."""
    rng = np.random.default_rng(seed)
    rows = []
    for r in (0.5, 1.0, 1.5):
        for a in np.linspace(0, 2 * np.pi, 12, endpoint=False):
            pose = np.array([r * np.cos(a), r * np.sin(a), rng.uniform(-3, 3)])
            true = se2.transform(se2.inverse(pose), np.zeros((1, 2)))[0]
            rows.append([*pose, *(true + rng.normal(0, 0.004, 2)), pose[2] + rng.normal(0, 0.002)])
    return np.array(rows)


HEADER = "x_m,y_m,theta_rad,seen_x_m,seen_y_m,seen_theta_rad"


def csv(path: Path, rows: Array, header: str = HEADER) -> Path:
    path.write_text("\n".join([header, *(",".join(f"{v:.6f}" for v in r) for r in rows)]) + "\n")
    return path


def test_measured_poses_become_errors_in_base(tmp_path: Path) -> None:
    e = errors_of_csv(csv(tmp_path / "s.csv", poses()), None)
    np.testing.assert_allclose(np.unique(np.round(e.r_m, 4)), [0.5, 1.0, 1.5])
    assert 0.003 < e.dx_m.std() < 0.005
    assert fit(e).sigma_theta_rad < 0.003


@pytest.mark.parametrize(
    ("rows", "header", "reason"),
    [
        (poses() * [1e3, 1e3, 1, 1e3, 1e3, 1], HEADER, "looks like millimetres; pass --units mm"),
        (poses() * [1, 1, 57.3, 1, 1, 57.3], HEADER, "is it in degrees"),
        (poses()[:, [3, 4, 2, 0, 1, 5]] * [1, -1, 1, 1, 1, 1], HEADER, "are columns swapped"),
        (poses()[:, :5], HEADER.replace(",seen_theta_rad", ""), "column 'seen_theta_rad' is missing"),
        (np.tile([0.001, 0.5, 0.5, 0.01], (30, 1)), "r_m,dx_m,dy_m,dtheta_rad", "are columns swapped"),
    ],
    ids=["mm", "degrees", "swapped", "missing", "errors swapped"],
)
def test_a_bad_csv_is_refused_with_its_reason(tmp_path: Path, rows: Array, header: str, reason: str) -> None:
    with pytest.raises(CalibrationError, match=reason):
        errors_of_csv(csv(tmp_path / "s.csv", rows, header), None)
