"""Points of pictures that are read row by row while the robot turns, against where lamps hang."""

from __future__ import annotations

import numpy as np
from point_ceilings import PLASTER_ROUND, VIEW_DEG, followed, lamps_at, off_m

from ceilvo.crossing_types import LAMP
from ceilvo.daemon.vision.points.stage import PointFinder
from ceilvo.daemon.vision.rolling_shutter import RollingShutter, TwistPrior
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.world import World, WorldSpec

SEED, READOUT_S = 23, 0.02
LAP = LapSpec(room_m=4.6, speed_mps=1.0, corner_radius_m=1.0 / 1.5)
SIGMA = np.array([0.05, 0.05, 0.05])
"""m/s, m/s, rad/s."""


def room(readout_s: float = READOUT_S) -> World:
    calibration = simulated_calibration(simulated_camera(readout_s=readout_s))
    out = World(WorldSpec(seed=SEED, ceiling=PLASTER_ROUND, lap=LAP), calibration)
    out.start(0)
    return out


def test_lamps_are_where_they_hang_though_the_robot_turns() -> None:
    """1.5 rad/s at 1 m/s: rows at the picture's side are 15 mrad and 10 mm from the middle's."""
    world = room()
    shutter, finder = RollingShutter(world.calibration, VIEW_DEG), PointFinder(world.calibration, VIEW_DEG)
    moved, left = [], []
    for t_s in np.arange(1.0, 12.0, 0.25):
        twist = world.twist_at(np.array([t_s]))[0]
        at = lamps_at(world, world.truth_at(t_s), np.zeros(2))
        gray = world.frame_at(t_s)
        with_it, _ = finder(gray, None, None, readout=shutter.readout(TwistPrior(twist, SIGMA)))
        without, _ = finder(gray, None, None)
        if not len(at):
            continue
        assert with_it is not None and without is not None
        moved += off_m(with_it, LAMP, at).tolist()
        left += off_m(without, LAMP, at).tolist()
    print(f"seed {SEED}: {len(moved)} lamps, at most {1e3 * max(moved):.2f} mm off, {1e3 * max(left):.1f} as read")
    assert len(moved) > 40
    assert max(moved) < 2e-3
    assert max(left) > 8e-3
    without_error, _ = finder(gray, None, None, readout=shutter.readout(TwistPrior(twist, 1e-3 * SIGMA)))
    assert without_error is not None
    vague = with_it.cov_base_m2 - without_error.cov_base_m2
    assert np.all(np.linalg.eigvalsh(vague) > -1e-12), "what the twist is off by is said"
    assert float(np.sqrt(np.max(vague))) < 0.5 * READOUT_S * (0.05 + 0.05 * 2.5), "m/s, and rad/s at 2.5 m"


def test_a_drive_under_lamps_alone_is_as_good_as_with_a_global_shutter() -> None:
    worst = {}
    for readout_s in (0.0, READOUT_S):
        _, off = followed(room(readout_s), 1.5, 75)
        worst[readout_s] = float(np.max(off))
    print(f"seed {SEED}: {1e3 * worst[READOUT_S]:.1f} mm at most, global {1e3 * worst[0.0]:.1f}")
    assert worst[READOUT_S] < 1.5 * worst[0.0] + 1e-3
