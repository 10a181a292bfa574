"""Reversed axes and swapped wheels are noticed within a metre of what shows them; laps with slips are not."""

from dataclasses import replace

import numpy as np
import pytest
from told_drives import DRIVING, ahead, paths_of, seen, told

from ceilvo import se2
from ceilvo.bench.cross_checks.drives import Path, drive, reversed_wheels, wheel_motion
from ceilvo.daemon.odometry.cross_checks.paths import Paths
from ceilvo.daemon.odometry.cross_checks.reversal import Reversal
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion

SLIPPING = replace(DRIVING, slips_per_m=0.5, slip_share=0.95, slip_radps=0.6, wheel_turn_scale=0.8)


def against(path: Path, rng: np.random.Generator) -> tuple[float, float, Suspicion | None]:
    """Way and turn that wheels and eye were apart, by 60 deg or in sense, until it was said."""
    check, paths, apart_m, apart_rad = Reversal(), Paths(), 0.0, 0.0
    for before_s, now_s in zip(path.time_s, path.time_s[1:], strict=False):
        step, wheels = se2.between(path.truth_at(before_s), path.truth_at(now_s)), wheel_motion(path, before_s, now_s)
        paths.add(seen(step, rng), wheels, float(now_s - before_s))
        said = check.step(paths, 0.0)
        if said:
            return apart_m, apart_rad, said[0]
        cosine = float(step[:2] @ wheels.prev_from_curr[:2])
        apart = cosine < 0.5 * np.hypot(*step[:2]) * np.hypot(*wheels.prev_from_curr[:2])
        apart_m += float(np.hypot(*step[:2])) * apart
        apart_rad += abs(float(step[2])) * (step[2] * wheels.prev_from_curr[2] < 0.0)
    return apart_m, apart_rad, None


@pytest.mark.parametrize("which", ["x", "y", "theta", "swapped"])
@pytest.mark.parametrize("seed", [80, 81, 82])
def test_reversed_wheels_are_said_within_a_metre(which: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    apart_m, apart_rad, said = against(reversed_wheels(drive(DRIVING, 120.0, rng), which), rng)
    assert said is not None
    assert (said.kind, said.severity) == (Kind.WHEELS_REVERSED, Severity.DEGRADED)
    assert apart_m < 1.0
    assert apart_rad < 2.0


@pytest.mark.parametrize("seed", [83, 84])
def test_slips_and_skids_are_no_reversal(seed: int) -> None:
    check = Reversal()
    assert [s for _, paths in paths_of(told(SLIPPING, 400.0, seed)) for s in check.step(paths, 0.0)] == []


def motions(check: Reversal, paths: Paths, metres: float, eye: float, broken: bool = False) -> list[Suspicion]:
    """Straight on, with an eye that sees `eye` times the way; the first motion begins vision's path anew if broken."""
    said, rng, step = [], np.random.default_rng(1), np.array([0.02, 0.0, 0.0])
    for k in range(round(metres / 0.02)):
        motion = seen(eye * step, rng)
        if broken and k == 0:
            motion = replace(motion, failure="jumped", restarted=True)
        paths.add(motion, ahead(0.02), 1.0 / 30.0)
        said = check.step(paths, 0.0)
    return said


def test_a_picture_that_is_turned_in_a_gap_is_to_blame_itself_until_it_agrees_again() -> None:
    check, paths = Reversal(), Paths()
    assert motions(check, paths, 3.0, 1.0) == []
    (said,) = motions(check, paths, 0.8, -1.0, broken=True)
    assert (said.kind, said.severity) == (Kind.PICTURE_TURNED, Severity.IN_DOUBT)
    assert motions(check, paths, 2.5, 1.0, broken=True) == []


def test_without_a_gap_it_is_the_wheels_that_lie_and_they_do_not_count_again_after_a_straight() -> None:
    check, paths = Reversal(), Paths()
    assert motions(check, paths, 3.0, 1.0) == []
    (said,) = motions(check, paths, 0.8, -1.0)
    assert said.kind is Kind.WHEELS_REVERSED
    (said,) = motions(check, paths, 30.0, 1.0)
    assert said.kind is Kind.WHEELS_REVERSED
