"""The two experiments' least squares: a spin is a circle about the base's origin, a run is along the base's x."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.solve.mount.tracks import Track, continuous, poses, refine_level
from ceilvo.camera import CameraModel

Array = NDArray[np.float64]

_ROUNDS = 3
"""Of the run's turn; chosen: the first one starts from the steps' mean direction, which is near."""


@dataclass(frozen=True)
class Solution:
    """values: x, y, yaw; level: roll, pitch, height as refined; tracks without outliers, each picture's own pose, and
    the camera's poses in one lattice; residuals of both experiments."""

    values: Array
    level: Array
    tracks: list[Track]
    own: list[Array]
    spin: Array
    run: Array
    spin_off: Array
    run_off: Array
    run_base: Array
    run_m: float


def solve(camera: CameraModel, tracks: list[Track], tile_m: float, level: Array) -> Solution:
    """Tilt and height are refined, each picture's pose follows, then the two experiments."""
    level = refine_level(camera, tracks, tile_m, level)
    own, clean = [], []
    for track in tracks:
        found, samples = poses(camera, track.samples, tile_m, level)
        own.append(found)
        clean.append(Track(samples, track.rows))
    return experiments(level, clean, own, tile_m)


def experiments(level: Array, tracks: list[Track], own: list[Array], tile_m: float) -> Solution:
    spin, run = (continuous(part, tile_m) for part in own)
    q, spin_off = _spin(spin)
    yaw, run_off, base, run_m = _run(run, q)
    xy = se2.rotation(yaw) @ q
    return Solution(np.array([*xy, yaw]), level, tracks, own, spin, run, spin_off, run_off, base, run_m)


def _spin(poses: Array) -> tuple[Array, Array]:
    """The camera's offset in its own axes, and (N, 2) residuals: it moves on a circle about the base's origin."""
    a = circle_design(poses[:, 2])
    b = poses[:, :2].ravel()
    x = np.linalg.lstsq(a, b, rcond=None)[0]
    return np.asarray(x[2:], np.float64), np.asarray((b - a @ x).reshape(-1, 2))


def circle_design(heading: Array) -> Array:
    """(2 N, 4) of the linear model: place = centre (2) + the offset (2) turned by the heading (N,)."""
    n = len(heading)
    a = np.zeros((2 * n, 4))
    a[0::2, 0] = a[1::2, 1] = 1.0
    c, s = np.cos(heading), np.sin(heading)
    a[0::2, 2], a[0::2, 3], a[1::2, 2], a[1::2, 3] = c, -s, s, c
    return a


def _run(poses: Array, q: Array) -> tuple[float, Array, Array, float]:
    """Yaw of the camera, residuals (N, 2), path of base (N, 2) and its length: base moves along its own x."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    base = poses[:, :2] - np.column_stack([c * q[0] - s * q[1], s * q[0] + c * q[1]])
    middle = 0.5 * (poses[1:, 2] + poses[:-1, 2])
    heading = np.column_stack([np.cos(middle), np.sin(middle)])
    step = np.diff(base, axis=0)
    turned = _angle(np.sum(step * heading), np.sum(heading[:, 0] * step[:, 1] - heading[:, 1] * step[:, 0]))
    for _ in range(_ROUNDS):
        along = np.sum(step * (heading @ se2.rotation(turned).T), axis=1)
        u = np.concatenate([np.zeros((1, 2)), np.cumsum(along[:, None] * heading, axis=0)])
        du, db = u - u.mean(axis=0), base - base.mean(axis=0)
        turned = _angle(np.sum(du * db), np.sum(du[:, 0] * db[:, 1] - du[:, 1] * db[:, 0]))
    off = db - du @ se2.rotation(turned).T
    # base's x axis is seen turned by `turned` from the camera's, so the camera is turned by the opposite in base
    return se2.wrap(-turned), off, base, float(np.hypot(*(base[-1] - base[0])))


def _angle(cosine: float, sine: float) -> float:
    return float(np.arctan2(sine, cosine))
