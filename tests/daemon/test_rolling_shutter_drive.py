"""A bend at 1 m/s and 1.5 rad/s: most of what a rolling shutter of 20 ms costs is taken out (docs/method.md)."""

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
LEFT = 0.2
"""Of the error without a correction; measured 0.09 at 480 x 360 px, where a global shutter leaves 0.02."""


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


def test_most_of_what_a_rolling_shutter_costs_is_taken_out() -> None:
    corrected, uncorrected = worst(0.02, 0.02), worst(0.02, 0.0)
    for name, (off_m, off_rad) in (("corrected", corrected), ("uncorrected", uncorrected)):
        print(f"seed {SEED} {name}: {1e3 * off_m:.2f} mm, {np.degrees(off_rad):.4f} deg")
    assert corrected[0] < LEFT * uncorrected[0]
    assert corrected[1] < LEFT * uncorrected[1]
