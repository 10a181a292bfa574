"""Lines at several heights, drawn by hand, as a camera takes them that knows of one."""

from __future__ import annotations

import numpy as np

from ceilvo import se2
from ceilvo.crossing_types import crossing_type_of
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Crossings

CALIBRATION = simulated_calibration()
HIGH_M = CALIBRATION.ceiling_height_m
NOISE_M = 0.0001
SEED = 5


def seen(
    lines: list[tuple[int, float, float]], pose: Array, rng: np.random.Generator, noise_m: float = NOISE_M
) -> tuple[Crossings, Array]:
    """Crossings of all lines (axis, place in map, height above the camera) that are alike in height, as a camera at a
    pose (3,) takes them for ones at the calibrated height; and where they are in base."""
    camera = se2.transform(pose, CALIBRATION.mount_xy_m[None])[0]
    error = rng.normal(0.0, noise_m, len(lines))
    apparent = [(at - camera[axis]) * HIGH_M / high for axis, at, high in lines] + error
    pairs = [
        (i, j)
        for i, (a, _, high) in enumerate(lines)
        for j, (b, _, other) in enumerate(lines)
        if (a, b) == (0, 1) and high == other
    ]
    from_camera = np.array([[apparent[i], apparent[j]] for i, j in pairs])
    true = np.array([[lines[i][1], lines[j][1]] for i, j in pairs])
    turn = se2.rotation(float(pose[2]))
    groove = np.zeros(len(pairs), np.int64)
    zero = np.zeros(2)
    crossings = Crossings(
        uv_px=np.zeros((len(pairs), 2)),
        xy_base_m=CALIBRATION.mount_xy_m + from_camera @ turn,
        cov_base_m2=np.broadcast_to(1e-6 * np.eye(2), (len(pairs), 2, 2)),
        crossing_type=crossing_type_of(groove, groove),
        psi_rad=-float(pose[2]),
        psi_sigma_rad=1e-4,
        tilt_rad=zero,
        tilt_sigma_rad=zero,
        common_cov_m2=np.zeros((2, 2)),
    )
    return crossings, se2.transform(se2.inverse(pose), true)


def grid(high_m: float, first: float, count: int, spacing_m: float = 0.6) -> list[tuple[int, float, float]]:
    return [(axis, first + k * spacing_m, high_m) for axis in (0, 1) for k in range(count)]


TWO_HEIGHTS = [*grid(HIGH_M, -1.2, 4), *((axis, at + 0.3, high) for axis, at, high in grid(HIGH_M - 0.4, -1.2, 4))]
"""Lines of a ceiling and, between them, of a lower one."""
