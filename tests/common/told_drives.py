"""Drives as wheels and a perfect eye tell them, fed to checks without pictures: hours pass in seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ceilvo import se2
from ceilvo.bench.cross_checks.drives import DriveSpec, Path, drive, wheel_motion
from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.types import Array, Displacement, Motion, WheelMotion

EYE_SIGMA = np.array([1e-4, 1e-4, 1e-5])
"""m, m, rad of one motion: as vision's on rendered frames (docs/bench.md)."""
DRIVING = DriveSpec(speeds_mps=(0.2, 0.6), stand_share=0.1, rate_hz=15.0)


def seen(step: Array, rng: np.random.Generator) -> Motion:
    """A motion that vision measured."""
    noise = EYE_SIGMA * rng.standard_normal(3)
    return Motion(Displacement(np.asarray(step + noise)), np.diag(EYE_SIGMA**2), 40, 1e-4)


def blind(step: Array) -> Motion:
    """A motion that nobody measured, predicted."""
    return Motion(Displacement(step), np.eye(3) * 1e-4, 0, 0.0, "dark")


def told(
    spec: DriveSpec, seconds: float, seed: int, late_s: float = 0.0, turned: Callable[[Path], Path] = lambda p: p
) -> Iterator[tuple[float, Motion, WheelMotion, float]]:
    """Time, eye's motion, wheels' motion and elapsed time of every frame; pictures are late_s late."""
    rng = np.random.default_rng(seed)
    path = turned(drive(spec, seconds, rng))
    for before_s, now_s in zip(path.time_s, path.time_s[1:], strict=False):
        step = se2.between(*(path.truth_at(max(t - late_s, 0.0)) for t in (before_s, now_s)))
        yield float(now_s), seen(step, rng), wheel_motion(path, before_s, now_s), float(now_s - before_s)


def still() -> WheelMotion:
    """Wheels that stand."""
    return WheelMotion(Displacement(np.zeros(3)), np.diag([1e-9, 1e-9, 1e-11]))


def ahead(step_m: float, turn_rad: float = 0.0) -> WheelMotion:
    """Wheels that move on."""
    var = 1e-9 + 1e-4 * abs(step_m) + 4e-4 * abs(turn_rad)
    return WheelMotion(Displacement(np.array([step_m, 0.0, turn_rad])), np.diag([var, var, var]))


def paths_of(motions: Iterator[tuple[float, Motion, WheelMotion, float]]) -> Iterator[tuple[float, Paths]]:
    """The paths after every frame."""
    paths = Paths()
    for now_s, motion, wheels, elapsed_s in motions:
        paths.add(motion, wheels, elapsed_s)
        yield now_s, paths
