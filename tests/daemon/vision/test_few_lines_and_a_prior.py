"""What few short lines say of the tilt, combined with a prior that is sure: a covariance stays one."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.config import Features
from ceilvo.daemon.vision.edge_points import Points
from ceilvo.daemon.vision.line_fit import JointFit
from ceilvo.daemon.vision.tilt_prior import TiltPrior

FOCAL_PX = 410.0


def fitted(lines: int, points: int, length_px: float, seed: int) -> JointFit:
    """Of short lines of one direction, side by side, 0.3 px off."""
    rng = np.random.default_rng(seed)
    offset = np.sort(rng.uniform(-150.0, 150.0, lines))
    across = (np.repeat(offset, points) + rng.normal(0.0, 0.3, lines * points)) / FOCAL_PX
    along = np.tile(rng.uniform(-100.0, 100.0) + np.linspace(0.0, length_px, points), lines) / FOCAL_PX
    count = lines * points
    found = Points(across.astype(np.float32), along.astype(np.float32), (0, count, count, count, count), np.inf)
    none = np.zeros(0)
    fit = JointFit(found, 0.0, [offset, none, none, none], FOCAL_PX, Features(), 1.0, np.zeros(2))
    fit.start(np.repeat(np.arange(lines), points).astype(np.int32), offset)
    fit.solve()
    return fit


@given(st.integers(1, 4), st.integers(2, 30), st.floats(0.5, 80.0), st.integers(0, 2**32 - 1), st.floats(-5.0, -2.0))
@settings(deadline=None)
def test_what_is_left_of_an_unknown_tilt_is_a_covariance(
    lines: int, points: int, length_px: float, seed: int, log_sigma: float
) -> None:
    fit = fitted(lines, points, length_px, seed)
    fit.finish()
    prior = TiltPrior(fit.tilt + 1e-6, np.full(2, 10.0**log_sigma))
    fit.apply_prior(prior)
    variance = np.diag(fit.covariance)
    assert np.all(variance > 0.0), f"{variance} (seed {seed})"
    assert np.all(np.sqrt(variance[1:]) <= 1.001 * prior.sigma_rad), "no worse than the prior"
