"""Ceilings of long boards: their joints go one way, and at most one joint crosses them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from crossing_camera import CrossingCamera, Flaws
from drawn_crossings import crossings_at
from odometry_robot import Robot

from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.types import Array, Crossings

BOARDS = CeilingSpec(room_m=20.0, tile_m=0.3, tile_y_m=4.0, lamp_every=(0, 0), vents=0, spots=0, stains=0)
RATE_HZ, SPEED_MPS = 15.0, 0.5
SEAM_Y_M = BOARDS.grid_offset_m[1] + 2 * 4.0
"""Where boards end: the only joint along x for 4 m either way."""


@dataclass(frozen=True)
class WithStrays:
    """A camera that turns its lines by a little, and sees things that are nowhere, anew in every frame."""

    camera: CrossingCamera
    count: int

    def sees(self, pose: Array, seed: int) -> Crossings:
        rng = np.random.default_rng([seed, 0x57A])
        seen = self.camera.sees(pose + np.array([0.0, 0.0, rng.normal(0.0, 1e-4)]), seed)
        at = rng.uniform(-1.0, 1.0, (self.count, 2))
        kind = seen.crossing_type[:1].repeat(self.count)
        strays = crossings_at(at, kind, 1e-3)
        return replace(
            seen,
            uv_px=np.vstack([seen.uv_px, strays.uv_px]),
            xy_base_m=np.vstack([seen.xy_base_m, strays.xy_base_m]),
            cov_base_m2=np.concatenate([seen.cov_base_m2, strays.cov_base_m2]),
            crossing_type=np.append(seen.crossing_type, kind),
        )


@pytest.mark.parametrize("heading_rad", [0.0, np.pi / 2])
@pytest.mark.parametrize("strays", [0, 1])
def test_crossings_of_one_joint_are_a_motion(heading_rad: float, strays: int) -> None:
    """They determine no homography, nor do they with one that is mistaken: at 1d35dc0 RANSAC kept any few of them."""
    ahead = np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0])
    for seed in range(80, 90):
        aside_m = np.random.default_rng([seed, 0xA51]).uniform(-0.15, 0.15, 2)
        start = np.array([10.0 + aside_m[0], SEAM_Y_M + aside_m[1], heading_rad])
        poses = [start + way_m * ahead for way_m in np.arange(0.0, 1.0, SPEED_MPS / RATE_HZ)]
        camera = WithStrays(CrossingCamera.under(BOARDS, seed, Flaws(lines=0.0, noise_m=0.0)), strays)
        robot, failed, off_m = Robot(camera, poses[0], RATE_HZ), [], []
        for pose in poses:
            motion, track = robot.step(pose)
            failed += [] if motion.ok else [motion.failure]
            off_m.append(float(np.hypot(*robot.error(track)[:2])))
        print(f"seed {seed}: a step is {1e3 * max(off_m):.2f} mm off at most")
        assert failed == ["first frame"]
        assert max(off_m) < 0.002, "the direction errs by .2 mrad, the joint is .15 m away"
