"""What offset and yaw are worth: scatter of both experiments, a robot that wanders, and the lens' own uncertainty."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.grid import grid_residuals
from ceilvo.calib.solve.lens import lens_of
from ceilvo.calib.solve.mount.fit import Solution, circle_design, experiments
from ceilvo.calib.solve.mount.tracks import thinning
from ceilvo.camera import CameraModel

Array = NDArray[np.float64]

_BLOCKS = 8
"""Stretches of an experiment whose residuals err together; chosen: half a turn each where four are made."""
_STANDING_TURNS = 0.6
"""Wandering that goes round less often in the whole spin is taken up by the circle's centre."""
_MOVE_M = 1e-6
"""By which poses are moved to differentiate: far below a residual, far above rounding."""
_UNMOVED = 1e-9
"""m per unit of a lens parameter below which the poses do not depend on it."""
_TINY = 1e-300
"""Keeps a division by zero away."""


def covariance(camera: CameraModel, s: Solution, tile_m: float) -> Array:
    """(3, 3) of x, y, yaw from the residuals, neighbours counting as one: they err together."""
    q_cov = _block_cov(circle_design(s.spin[:, 2]), s.spin_off)[2:, 2:] + _wander_var(
        s.spin[:, 2], s.spin_off
    ) * np.eye(2)
    yaw = float(s.values[2])
    u = s.run_base - s.run_base.mean(axis=0)
    across = np.column_stack([-u[:, 1], u[:, 0]])
    m = len(u)
    b = np.zeros((2 * m, 3))
    b[0::2, 0] = b[1::2, 1] = 1.0
    b[:, 2] = across.ravel()
    # errors of places change so slowly under a grid that the scatter along the path does not show them: two ends count
    yaw_var = max(_block_cov(b, s.run_off)[2, 2], 2.0 * (_place_sigma(camera, s, tile_m) / s.run_m) ** 2)
    rot = se2.rotation(yaw)
    lever = np.array([-s.values[1], s.values[0]])
    cov = np.zeros((3, 3))
    cov[:2, :2] = rot @ q_cov @ rot.T + yaw_var * np.outer(lever, lever)
    cov[:2, 2] = cov[2, :2] = yaw_var * lever
    cov[2, 2] = yaw_var
    return cov


def _place_sigma(camera: CameraModel, s: Solution, tile_m: float) -> float:
    """Of a picture's place in the run, m, from its crossings' residuals."""
    residuals = grid_residuals(camera, s.tracks[1].samples, tile_m)
    variances = [
        float(np.mean(residuals(i, s.level, v) ** 2)) / len(t.index)
        for i, (v, t) in enumerate(zip(s.own[1], s.tracks[1].samples, strict=True))
    ]
    return float(np.sqrt(np.mean(variances)) * s.level[2] / camera.fx_px)


def _wander_var(heading: Array, off: Array) -> float:
    """Variance of each coordinate of the offset from a robot that does not turn exactly on the spot.

    Wandering that goes round once a turn looks the same as an offset; how much of it there is follows from wandering
    of nearly the same frequency: what goes round once or twice more, or less often, in the whole spin.
    """
    turns = float(np.ptp(heading)) / (2.0 * np.pi)
    frequencies = [1.0 + j / turns for j in (-2, -1, 1, 2)]
    z = off[:, 0] + 1j * off[:, 1]
    powers = [abs(np.mean(z * np.exp(-1j * k * heading))) ** 2 for k in frequencies if abs(k) * turns > _STANDING_TURNS]
    return float(np.mean(powers) / 2.0)


def _block_cov(a: Array, off: Array) -> Array:
    """Of a least squares' solution: the larger of independent rows and of rows that are alike within blocks."""
    inverse = np.linalg.inv(a.T @ a)
    r = off.ravel()
    white = inverse * float(r @ r) / max(len(r) - a.shape[1], 1)
    meat = np.zeros_like(inverse)
    for rows in np.array_split(np.arange(len(r)), _BLOCKS):
        score = a[rows].T @ r[rows]
        meat += np.outer(score, score)
    block = inverse @ meat @ inverse * _BLOCKS / max(_BLOCKS - a.shape[1], 1)
    grow = np.sqrt(np.maximum(np.diag(block) / np.maximum(np.diag(white), _TINY), 1.0))
    return np.asarray(white * np.outer(grow, grow))


def lens_response(camera: CameraModel, best: Solution, tile_m: float, count: int) -> Array:
    """(3, count) how the values move with the lens' parameters: tilt and height follow, then the pictures' poses."""
    lens = lens_of(camera)
    if lens is None:
        return np.zeros((3, count))
    of, p = lens
    every = [s for t in best.tracks for s in t.samples]
    poses = np.concatenate(best.own)
    step = thinning(every)
    some = every[::step]
    level, _ = bundle.response(lambda q: grid_residuals(of(q), some, tile_m), p, best.level, poses[::step])

    def given(q: Array) -> bundle.Residuals:
        residuals = grid_residuals(of(q), every, tile_m)
        return lambda i, _, view: residuals(i, best.level + level @ (q - p), view)

    _, own = bundle.response(given, p, np.zeros(0), poses)
    parts = np.split(own, [len(best.own[0])])
    moved = []
    for k in range(count):
        h = _MOVE_M / max(float(np.abs(own[:, :, k]).max()), _UNMOVED)
        ends = [
            experiments(
                best.level, best.tracks, [o + f * h * d[:, :, k] for o, d in zip(best.own, parts, strict=True)], tile_m
            )
            for f in (1.0, -1.0)
        ]
        moved.append((ends[0].values - ends[1].values) / (2.0 * h))
    return np.column_stack(moved)
