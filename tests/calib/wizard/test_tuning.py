"""Exposure and gain of the simulated camera: flicker by its own arithmetic, and what is told of it."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest

from ceilvo.calib.evaluate.survey import flicker
from ceilvo.calib.practice.virtual_exposure import VirtualExposure


def light(exposure_us: float | None, gain: float | None = 8.0, frames: int = 90) -> list[tuple[float, float]]:
    camera = VirtualExposure(exposure_us, gain)
    return [(1e-9 * p.stamp_ns, float(p.gray.mean())) for p in islice(camera, frames)]


@pytest.mark.parametrize("exposure_us", [3000.0, 7000.0, 13000.0])
def test_ripple_is_that_of_an_exposure_under_lamps_of_a_hundred_hertz(exposure_us: float) -> None:
    found = flicker(light(exposure_us))
    x = 2.0 * np.pi * 100.0 * 1e-6 * exposure_us / 2.0
    expected = 0.25 * abs(np.sin(x) / x)
    assert found.mains_hz == 50.0
    assert found.amplitude == pytest.approx(expected, rel=0.15)
    assert 10_000 in found.exposures_us


@pytest.mark.parametrize("exposure_us", [10_000.0, 20_000.0])
def test_whole_half_periods_do_not_flicker(exposure_us: float) -> None:
    assert flicker(light(exposure_us, 2.0)).mains_hz == 0.0


def test_light_grows_with_exposure_and_gain_until_it_is_white() -> None:
    means = [light(us, 8.0, 1)[0][1] for us in (2000.0, 4000.0, 8000.0)]
    assert means[1] / means[0] == pytest.approx(2.0, rel=0.3) and means[2] > means[1]
    dark, bright = next(iter(VirtualExposure(10_000.0, 0.0))), next(iter(VirtualExposure(40_000.0, 64.0)))
    assert np.mean(bright.gray >= 253) > 0.5 and np.mean(dark.gray >= 253) == 0.0
