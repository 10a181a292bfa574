"""Edges of two lamps that nearly lie in one line are two lines: taken for one they would turn the direction."""

import numpy as np
import pytest

from ceilvo.config import Features
from ceilvo.daemon.vision.edge_points import Points
from ceilvo.daemon.vision.line_fit import JointFit

FOCAL_PX = 410.0
NOISE_PX = 0.1
ENDS = (-75.0, -20.0), (215.0, 284.0)
"""Where the two lamps' short sides begin and end along a line, px: 2.5 m apart on a ceiling 2.7 m high."""


def lamps(across_px: float, seed: int, turned_rad: float = 0.0) -> JointFit:
    """One line of edges of two lamps, of which the second is so far beside the first, and their long sides.

    As a detector hands them over: all points of the two lamps on one line, at the direction that is best for it.
    """
    rng = np.random.default_rng(seed)
    rho, tangent, line = [], [], []
    for (a, b), off in zip(ENDS, (280.0, 280.0 + across_px), strict=True):
        at = np.arange(a, b)
        rho.append(off + rng.normal(0.0, NOISE_PX, len(at)))
        tangent.append(at)
        line.append(np.zeros(len(at), np.int32))
    half = sum(len(r) for r in rho)
    for k, off in enumerate((-80.0, -25.0, 230.0, 240.0)):
        at = np.arange(-352.0, -282.0)
        rho.append(off + rng.normal(0.0, NOISE_PX, len(at)))
        tangent.append(at)
        line.append(np.full(len(at), k + 1, np.int32))
    r, t, line_of = (np.concatenate(v) for v in (rho, tangent, line))
    # rays of axis 0 are (rho, tangent), of axis 1 (-tangent, rho), turned by the direction that is to be found
    x = np.where(np.arange(len(r)) < half, r, -t) / FOCAL_PX
    y = np.where(np.arange(len(r)) < half, t, r) / FOCAL_PX
    c, s = np.cos(turned_rad), np.sin(turned_rad)
    x, y = c * x - s * y, s * x + c * y
    points = Points(x.astype(np.float32), y.astype(np.float32), (0, half, half, len(r), len(r)), np.inf)
    starts = [np.array([280.0 + 0.5 * across_px]), np.zeros(0), np.array([-80.0, -25.0, 230.0, 240.0]), np.zeros(0)]
    fit = JointFit(points, 0.0, starts, FOCAL_PX, Features(), 1.0, np.zeros(2))
    fit.start(line_of, np.concatenate(starts))
    for _ in range(3):
        fit.solve(tilt=False)
    return fit


@pytest.mark.parametrize("across_px", [-4.6, -3.0, 3.0, 4.6])
@pytest.mark.parametrize("turned_rad", [0.0, 0.003])
def test_a_line_through_edges_of_two_lamps_is_cut(across_px: float, turned_rad: float) -> None:
    """The inner edge of a lamp's frame is 2 to 4 cm beside its outer one."""
    fit = lamps(across_px, 1, turned_rad)
    assert abs(fit.psi - turned_rad) > 0.005, "or there is nothing to be mended"
    fit.finish_held()
    sigma = float(np.sqrt(fit.covariance[0, 0]))
    print(f"seed 1, {across_px} px: {1e3 * (fit.psi - turned_rad):.2f} mrad off at a claimed {1e3 * sigma:.2f}")
    assert abs(fit.psi - turned_rad) < 3.0 * sigma < 0.01
    offsets = np.sort(fit.offset[fit.line_group == 0])
    assert len(offsets) == 2 and abs(offsets[1] - offsets[0] - abs(across_px)) < 1.0


def test_a_line_that_is_one_stays_one_and_keeps_its_accuracy() -> None:
    """Ends of a long lamp behind something in between, or edges of lamps that are in line."""
    cut, sigmas, off = 0, [], []
    for seed in range(40):
        fit = lamps(0.0, 100 + seed)
        fit.finish_held()
        cut += len(fit.offset) > 5
        sigmas.append(float(np.sqrt(fit.covariance[0, 0])))
        off.append(fit.psi / sigmas[-1])
    print(f"seeds 100-139: {cut} of 40 cut, {1e3 * np.median(sigmas):.2f} mrad claimed, {np.std(off):.2f} of it off")
    assert cut <= 4
    assert np.median(sigmas) < 1e-3
    assert np.std(off) < 1.5


def test_a_short_line_beside_long_ones_is_kept() -> None:
    """Short sides of a lamp are a quarter of its long ones."""
    fit = lamps(4.6, 3)
    fit.finish_held()
    assert np.all(np.bincount(fit.line, minlength=len(fit.offset)) > 40)
    assert len(fit.offset) == 6
