"""A bend at 1 m/s and 1.5 rad/s: a rolling shutter of 20 ms is as good as a global one, within 1.5 times."""

from __future__ import annotations

import numpy as np
import pytest

from ceilvo import se2
from ceilvo.config import Config
from ceilvo.config.reader import replace
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Frame

RATE_HZ, START_S, END_S = 30.0, 0.5, 3.6
SEED = 1
AS_GOOD = 1.5
KNOWN_M, KNOWN_RAD = 0.0005, float(np.radians(0.01))
"""Beyond the ratio: less than this is luck of a seed, with a global shutter as well."""


def worst(true_readout_s: float, assumed_readout_s: float) -> tuple[float, float]:
    """Largest error of position [m] and heading [rad] over a straight and a bend, 480 x 360 px."""
    true, assumed = (
        simulated_calibration(simulated_camera(width_px=480, height_px=360, readout_s=s))
        for s in (true_readout_s, assumed_readout_s)
    )
    lap = LapSpec(room_m=4.6, speed_mps=1.0, corner_radius_m=1.0 / 1.5)
    world = World(WorldSpec(seed=SEED, lap=lap), true)
    x, y, theta = world.truth_at(START_S)
    start = (f"filter.initial_pose_x_m={x}", f"filter.initial_pose_y_m={y}")
    start += (f"filter.initial_pose_theta_deg={np.degrees(theta)}",)
    pipeline = Pipeline(assumed, replace(Config(), start), np.random.default_rng(1))
    off = []
    for k in range(round((END_S - START_S) * RATE_HZ)):
        t_s = START_S + k / RATE_HZ
        estimate = pipeline.step(Frame(k, 10**9 + round(1e9 * t_s), world.frame_at(t_s)))
        pose = world.truth_at(t_s)
        off.append((np.hypot(*(estimate.pose - pose)[:2]), abs(se2.wrap(estimate.pose[2] - pose[2]))))
    assert np.abs(world.twist_at(np.arange(START_S, END_S, 0.01))[:, 2]).max() == pytest.approx(1.5, abs=0.01)
    return float(np.max(off, axis=0)[0]), float(np.max(off, axis=0)[1])


@pytest.mark.xfail(strict=True, reason="480 x 360 px, seed 1: found 4.07 mm of the global shutter's 0.67; not met")
def test_a_rolling_shutter_is_as_good_as_a_global_one_within_one_and_a_half_times() -> None:
    still, rolling, uncorrected = worst(0.0, 0.0), worst(0.02, 0.02), worst(0.02, 0.0)
    for name, (off_m, off_rad) in (("global", still), ("rolling", rolling), ("uncorrected", uncorrected)):
        print(f"seed {SEED} {name}: {1e3 * off_m:.2f} mm, {np.degrees(off_rad):.4f} deg")
    assert rolling[0] < AS_GOOD * still[0] + KNOWN_M
    assert rolling[1] < AS_GOOD * still[1] + KNOWN_RAD
    assert uncorrected[0] > 3.0 * rolling[0] or uncorrected[1] > 3.0 * rolling[1], "or the test shows nothing"
