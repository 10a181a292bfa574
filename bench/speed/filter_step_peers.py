"""The reference step with filterpy, particles and stonesoup; mrclam_peers' filters on a robot that stands still."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from ceilvo.bench.mrclam import peers
from ceilvo.bench.mrclam.data import World
from ceilvo.bench.mrclam.noise import Noise
from ceilvo.bench.mrclam.run import Event
from ceilvo.types import Array

STEPS_PER_CALL = 20
"""The peers' set-up is spread over them."""


def steppers(near: Array, particles: int, sigma_m: float) -> dict[str, Callable[[], None]]:
    """Those that are installed; a call is STEPS_PER_CALL steps."""
    world = World(np.arange(len(near), dtype=np.int64), near, {})
    noise = Noise((sigma_m, 0.0), (sigma_m, 0.0), (0.0, 2e-3), (0.0, 2e-3), (0.0, 0.0, 5e-4))
    moments = _standing(near, sigma_m)
    out: dict[str, Callable[[], None]] = {}
    for name, (library, work, gated) in peers.PEERS.items():
        if peers.missing(library) is None:
            out[name] = partial(_run, work, moments, world, noise, particles, gated)
    return out


def _run(
    work: Callable[..., peers.Path], moments: Sequence[Event], world: World, noise: Noise, particles: int, gated: bool
) -> None:
    work(moments, world, noise, particles, gated)


def skipped() -> list[str]:
    return [m for lib in dict.fromkeys(v[0] for v in peers.PEERS.values()) if (m := peers.missing(lib))]


def _standing(near: Array, sigma_m: float) -> list[Event]:
    rng = np.random.default_rng(7)
    r, b = np.hypot(*near.T), np.arctan2(near[:, 1], near[:, 0])
    subject = np.arange(len(near), dtype=np.int64)
    return [
        Event(
            0.2 * i,
            np.zeros(3),
            0.2,
            np.zeros(3),
            subject,
            r + sigma_m * rng.standard_normal(len(r)),
            b + sigma_m * rng.standard_normal(len(b)),
            True,
        )
        for i in range(STEPS_PER_CALL)
    ]
