"""calib survey: density, ambiguity, darkness, flicker, and the picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ceilvo.calib.evaluate.survey import DARK_LEVEL, Survey, ambiguity, flicker
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Crossings, Estimate, FilterHealth, Motion, State


def crossings(xy: Array) -> Crossings:
    n = len(xy)
    zero = np.zeros(2)
    return Crossings(
        xy, xy, np.tile(np.eye(2), (n, 1, 1)), np.full(n, 4, np.int64), 0.0, 0.001, zero, zero, np.zeros((2, 2))
    )


GRID = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-2, 3)), axis=-1).reshape(-1, 2) * 0.6


def test_a_pure_grid_is_ambiguous_and_a_random_ceiling_is_not() -> None:
    assert ambiguity(crossings(GRID), 0.6) == 1.0
    assert ambiguity(crossings(np.random.default_rng(1).uniform(-2, 2, (30, 2))), 0.6) < 0.4


def light(hz: float, depth: float, rate_hz: float, n: int = 300) -> list[tuple[float, float]]:
    rng = np.random.default_rng(1)
    t = np.arange(n) / rate_hz
    slow = 100.0 + 20.0 * np.sin(0.4 * t)
    return list(zip(t, slow * (1 + depth * np.sin(2 * np.pi * hz * t)) + rng.normal(0, 0.2, n), strict=True))


@pytest.mark.parametrize(("hz", "mains", "exposure"), [(100.0, 50.0, 10_000), (120.0, 60.0, 8_333)])
def test_flicker_is_found_at_its_alias_with_the_exposure_that_avoids_it(hz: float, mains: float, exposure: int) -> None:
    found = flicker(light(hz, 0.1, 27.0))
    assert found.mains_hz == mains and found.exposures_us[0] == exposure
    assert abs(found.amplitude - 0.1) < 0.03
    assert f"{exposure} or" in found.text


def test_steady_light_has_no_flicker() -> None:
    found = flicker(light(100.0, 0.0, 27.0))
    assert found.visible and found.mains_hz == 0 and "none" in found.text


def test_a_rate_that_hides_the_ripple_is_said_so() -> None:
    assert "cannot be seen" in flicker(light(100.0, 0.1, 20.0)).text
    assert "cannot be seen" in flicker(light(100.0, 0.1, 27.0, 8)).text


ESTIMATE = Estimate(
    0, 0, np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros(3), State.TRACKING, 1.0, "",
    Motion(np.zeros(3), np.zeros((3, 3)), 10, 0.0), FilterHealth(100, 50.0, 50, 0.0, 0.7, 20), 30, 10,
)  # fmt: skip


def drive(level: int, few: bool) -> Survey:
    survey = Survey(simulated_calibration())
    gray = np.full((480, 640), level, np.uint8)
    for i in range(40):
        seen = crossings(GRID[:4] if few else GRID)
        survey.add(gray, replace(ESTIMATE, pose=np.array([0.1 * i, 1.0, 0.0]), stamp_ns=i * 100_000_000), seen, not few)
    return survey


def test_a_good_ceiling_passes_and_its_repetition_is_noted() -> None:
    survey = drive(120, few=False)
    assert survey.problems() == []
    assert any("repeats itself" in n for n in survey.notes())
    assert 1.0 < survey.density < 6.0
    assert survey.picture().shape == (3 * 48, 10 * 48, 3)


def test_a_poor_and_dark_ceiling_fails_with_what_to_do() -> None:
    reported = " ".join(drive(int(DARK_LEVEL) - 5, few=True).problems())
    assert "fewer than 8 crossings" in reported and "dark" in reported and "vision failed in 100 %" in reported
