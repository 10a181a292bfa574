"""Wheels that slip are said, on their axis; wheels that do not are not."""

import numpy as np
import pytest

from ceilvo.daemon.odometry.senses.slip import AXES, Compared, SlipTest
from ceilvo.types import Array

DT_S, WAY = 0.07, np.array([0.035, 0.0, 0.02])
NOISE = np.array([1e-5, 1e-5, 1e-5]) * 0.04
ENDS = np.array([1e-3, 1e-3, 2e-3]) ** 2


def compared(counted: Array, moved: Array, known: Array | None = None) -> Compared:
    return Compared(
        counted, moved, np.ones(3) if known is None else known, NOISE, 0.002 * np.abs(moved), np.zeros(3), ENDS
    )


@pytest.mark.parametrize("axis", range(3))
def test_a_fifth_of_the_way_is_said_within_half_a_second_on_its_axis(axis: int) -> None:
    test, moved = SlipTest(), np.array([0.035, 0.035, 0.035])
    for k in range(100):
        false = test.step(compared(moved, moved), DT_S)
        assert false == [], k
    slipping = moved * (1.0 + 0.2 * (np.arange(3) == axis))
    said_s = None
    for k in range(15):
        found = test.step(compared(slipping, moved), DT_S)
        if found and said_s is None:
            said_s = (k + 1) * DT_S
            assert [s.axis for s in found] == [AXES[axis]]
            assert found[0].counted > found[0].moved
    assert said_s is not None
    assert said_s <= 0.5
    assert test.state.began.tolist() == [float(k == axis) for k in range(3)]


def test_it_is_over_when_they_agree_again() -> None:
    test = SlipTest()
    for _ in range(8):
        test.step(compared(1.5 * WAY, WAY), DT_S)
    assert any(test.slipping)
    for _ in range(20):
        test.step(compared(WAY, WAY), DT_S)
    assert not any(test.slipping)


def test_noise_as_large_as_said_is_no_slip() -> None:
    test, rng = SlipTest(), np.random.default_rng(7)
    edge = np.zeros(3)
    for _ in range(5000):
        before, edge = edge, rng.standard_normal(3) * np.sqrt(0.5 * ENDS)
        counted = WAY + rng.standard_normal(3) * np.sqrt(NOISE) + edge - before
        assert test.step(compared(counted, WAY), DT_S) == []


def test_an_axis_that_the_reference_does_not_tell_does_not_slip() -> None:
    test = SlipTest()
    for _ in range(10):
        found = test.step(compared(2.0 * WAY, WAY, np.array([0.0, 0.0, 1.0])), DT_S)
    assert [s.axis for s in found] == ["turning"]
