"""A simulated camera whose exposure and gain can be set, under lamps that flicker with the mains."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.targets.sources import Picture

Gray = NDArray[np.uint8]

_MAINS_HZ, _RIPPLE = 50.0, 0.25
"""Lamps shine at twice the mains, and so much more and less; chosen: as fluorescent tubes do."""
_USUAL_US, _USUAL_GAIN = 10_000.0, 16.0
"""Under which a picture is as the bench draws it."""
_AUTO_LEVEL = 120.0
"""Mean grey level that auto exposure aims for."""
_READ_NOISE = 0.6
"""Grey levels at the usual gain."""
RATE_HZ = 30.3
"""As cameras' clocks are: off the round number, so that flicker moves through the pictures."""
RANGES = {"exposure_us": (100.0, 40_000.0), "gain": (0.0, 64.0)}


class VirtualExposure:
    """The robot stands; exposure_us and gain may be changed between pictures, None = auto."""

    def __init__(self, exposure_us: float | None, gain: float | None, seed: int = 1) -> None:
        self.exposure_us, self.gain = exposure_us, gain
        self._rng = np.random.default_rng([seed, 0xE8])
        bench = VirtualBench(seed=seed)
        self._scene: Gray = next(iter(bench.places(1))).gray

    def __iter__(self) -> Iterator[Picture]:
        number = 0
        while True:
            t_s = 1.0 + number / RATE_HZ
            yield Picture(f"frame {number}", round(1e9 * t_s), self._picture(t_s))
            number += 1

    def _picture(self, t_s: float) -> Gray:
        scene = self._scene.astype(np.float32)
        gain = _USUAL_GAIN if self.gain is None else self.gain
        level = (1.0 + gain) / (1.0 + _USUAL_GAIN)
        exposure_s = 1e-6 * (
            _USUAL_US * _AUTO_LEVEL / (float(scene.mean()) * level) if self.exposure_us is None else self.exposure_us
        )
        light = level * exposure_s * 1e6 / _USUAL_US * _shining(t_s, exposure_s)
        noise = self._rng.normal(0.0, _READ_NOISE * level, scene.shape)
        return np.asarray(np.clip(scene * light + noise, 0, 255), np.uint8)


def _shining(t_s: float, exposure_s: float) -> float:
    """Mean light of the lamps during an exposure, 1 over whole half-periods."""
    w = 2.0 * np.pi * 2.0 * _MAINS_HZ
    return float(1.0 + _RIPPLE * (np.sin(w * (t_s + exposure_s)) - np.sin(w * t_s)) / (w * exposure_s))
