"""What noise curves leave out is learnt by the filter, up to a bound, and a wrong lens or height still shows."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from ceilvo.config import Config, Filter
from ceilvo.daemon.integrity.staleness import StalenessMonitor
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam import joint_rule
from ceilvo.daemon.slam.joint_rule import MODEL_SIGMA_M, MODEL_SIGMA_MAX_M
from ceilvo.se2 import compose, inverse, transform
from ceilvo.sim.world import World
from ceilvo.types import Array, Crossings, Displacement, Estimate, Landmarks, Motion, Observations, State

sys.path.insert(0, str(Path(__file__).parents[2] / "golden" / "pipeline"))
import golden_drives as drives

LAP = drives.load("lap", "joint")
WORLD = World(drives.WORLDS["lap"])
MOUNT = np.asarray(LAP.calibration.mount_xy_m)


def fresh(curves: float) -> Pipeline:
    """A pipeline whose noise curves are those of the simulated camera, which are cautious, times a factor."""
    n = LAP.calibration.noise
    scaled = tuple(tuple(curves * c for c in axis) for axis in (n.sigma_x_m, n.sigma_y_m))
    noise = replace(n, sigma_x_m=scaled[0], sigma_y_m=scaled[1], sigma_theta_rad=curves * n.sigma_theta_rad)
    return Pipeline(replace(LAP.calibration, noise=noise), LAP.config, np.random.default_rng(20))


def driven(pipeline: Pipeline, height: float = 1.0, bent: float = 0.0) -> list[Estimate]:
    """The golden lap; crossings as a camera reports them that believes in another height, or in another lens."""
    out, stamp_ns = [], 10**9
    for seen, wheels in zip(LAP.crossings, LAP.wheels, strict=True):
        stamp_ns += round(1e9 / drives.RATE_HZ)
        out.append(pipeline.step_crossings(stamp_ns, believed(seen, height, bent), wheels))
    return out


@cache
def driven_well(curves: float) -> tuple[Estimate, ...]:
    """With the right height and lens."""
    return tuple(driven(fresh(curves)))


def believed(seen: Crossings, height: float, bent: float) -> Crossings:
    arm = seen.xy_base_m - MOUNT
    r = np.hypot(*arm.T)[:, None] / LAP.calibration.ceiling_height_m
    return replace(seen, xy_base_m=MOUNT + height * (1.0 + bent * r**2) * arm)


def tracking(estimates: Sequence[Estimate]) -> float:
    return float(np.mean([e.state is State.TRACKING for e in estimates[10:]]))


def worst_m(estimates: Sequence[Estimate]) -> float:
    return max(float(np.hypot(*(e.pose - WORLD.truth_at(i / drives.RATE_HZ))[:2])) for i, e in enumerate(estimates))


def nis(estimates: Sequence[Estimate]) -> Array:
    return np.array([e.health.nis for e in estimates if e.health.nis_dof > 0])


@pytest.mark.parametrize("curves", [1.0, 1.0 / 3.0, 1.0 / 6.0, 1.0 / 10.0])
def test_a_good_pose_is_tracking_whatever_the_curves_leave_out(curves: float) -> None:
    estimates = driven_well(curves)
    share, mean = tracking(estimates), float(np.mean(nis(estimates)))
    print(f"curves x{curves:.2f}: TRACKING {share:.2f}, NIS {mean:.2f}, worst {1e3 * worst_m(estimates):.1f} mm")
    assert worst_m(estimates) < 0.009
    assert share >= 0.95
    assert mean < 2.0


def test_without_floor_and_with_all_features_the_same_drive_is_degraded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint_rule, "MODEL_SIGMA_MAX_M", 0.0)
    monkeypatch.setattr(joint_rule, "MOST_OTHERS", 0.0)
    pipeline = fresh(1.0 / 10.0)
    pipeline.filter.state.rule.model_var_m2 = 0.0
    estimates = driven(pipeline)
    assert tracking(estimates) < 0.9
    assert worst_m(estimates) < 0.009


@pytest.mark.parametrize("curves", [1.0, 1.0 / 6.0])
def test_a_lens_that_changed_is_beyond_what_is_learnt(curves: float) -> None:
    """NIS is above the bound of the staleness monitor, whose expected NIS is the good drive's."""
    good, bad = nis(driven_well(curves)), nis(driven(fresh(curves), bent=0.04))
    monitor = StalenessMonitor(float(np.mean(good)), window_s=20.0, hold_s=5.0)
    for i, value in enumerate(np.concatenate([good, bad, bad])):
        monitor.add(round(2e8 * i), float(value), 20)
        assert not (monitor.last.stale and i < len(good))
    print(f"curves x{curves:.2f}: NIS {np.mean(good):.2f} good, {np.mean(bad):.2f} with another lens")
    assert monitor.last.stale


def test_a_wrong_height_is_noticed_on_a_map_of_the_right_one() -> None:
    first = fresh(1.0 / 3.0)
    driven(first)
    axis = first.relocaliser.state.map_axis_rad
    assert axis is not None
    shares = {}
    for height in (1.0, 1.05):
        again = fresh(1.0 / 3.0)
        again.load_map(first.filter.landmarks(), axis, WORLD.truth_at(0.0), np.diag([1e-6] * 3))
        shares[height] = tracking(driven(again, height))
    print(f"TRACKING by height: {shares}")
    assert shares[1.0] > 0.8
    assert shares[1.05] < 0.1


def test_features_of_other_landmarks_are_left_out_only_where_most_fit_well() -> None:
    rng = np.random.default_rng(3)
    good, far = 0.05 * rng.chisquare(2.0, 70), np.full(30, 40.0)
    assert joint_rule.bulk_nis(np.concatenate([good, far])) < 0.1
    assert joint_rule.bulk_nis(np.concatenate([good[:50], far])) > 5.0, "more than a third"
    assert joint_rule.bulk_nis(np.concatenate([20.0 * good, far])) > 5.0, "the rest is no better than expected"
    assert joint_rule.bulk_nis(rng.chisquare(2.0, 4000)) == pytest.approx(1.0, abs=0.05)


def model_sigma(error_m: float, sigma_m: float = 0.002, updates: int = 600, off_m: float = 0.0) -> float:
    """What is learnt on a known map of points that are seen error_m off on average, beyond sigma_m."""
    rng = np.random.default_rng(7)
    points = rng.uniform(-3, 3, (200, 2))
    n = len(points)
    known = Landmarks(np.arange(n), points, np.tile(1e-10 * np.eye(2), (n, 1, 1)), np.zeros(n, np.int64), np.full(n, 9))
    f = make_filter(replace(Filter(), feature_independence=1.0, slip_per_m=0.0), np.random.default_rng(7))
    truth = np.array([1.0, 0.0, 0.5 * np.pi])
    f.reset(truth, 1e-8 * np.eye(3), known, known=True)
    for _ in range(updates):
        step = np.array([0.05, 0.0, 0.05])
        truth = compose(truth, step)
        f.predict(Motion(Displacement(step + 1e-4 * rng.standard_normal(3)), 1e-8 * np.eye(3), 9, 0.0))
        at = transform(inverse(truth), points)
        seen = np.flatnonzero(np.hypot(*at.T) < 1.0)
        z = at[seen] + np.hypot(error_m, sigma_m) * rng.standard_normal((len(seen), 2)) + [off_m, 0.0]
        f.update(Observations(z, np.full((len(seen), 2), sigma_m**2), np.zeros(len(seen), np.int64), seen))
    return float(np.sqrt(f.state.rule.model_var_m2))


@pytest.mark.parametrize(
    ("error_m", "expected_m"), [(0.0, 0.0), (0.002, 0.002), (0.004, 0.004), (0.02, MODEL_SIGMA_MAX_M)]
)
def test_the_error_that_curves_leave_out_is_learnt_within_a_bound(error_m: float, expected_m: float) -> None:
    assert model_sigma(error_m) == pytest.approx(expected_m, abs=0.0007)


def test_it_begins_where_it_is_said_to() -> None:
    f = make_filter(Config().filter, np.random.default_rng(1))
    assert f.state.rule.model_var_m2 == MODEL_SIGMA_M**2
