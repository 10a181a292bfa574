"""The sum of log-likelihood ratios: its stated rate of false alarms, and its memory."""

import numpy as np
import pytest

from ceilvo.daemon.odometry.cross_checks.sequential import Cusum, log_normal, threshold


def samples_until_alarm(rng: np.random.Generator, mean: float, between: float) -> int:
    test, count = Cusum(), 0
    while not test.alarm:
        x = float(rng.normal(mean, 1.0))
        test.add(log_normal(x, 1.0, 1.0) - log_normal(x, 0.0, 1.0), threshold(between))
        count += 1
    return count


def test_false_alarms_are_as_rare_as_stated_and_true_ones_quick() -> None:
    rng = np.random.default_rng(5)
    false = [samples_until_alarm(rng, 0.0, 200.0) for _ in range(60)]
    true = [samples_until_alarm(rng, 1.0, 200.0) for _ in range(60)]
    assert np.mean(false) > 200.0
    assert np.mean(true) < 20.0  # threshold over the mean ratio of 0.5, and a little


def test_what_speaks_against_it_does_not_pile_up() -> None:
    test = Cusum()
    for _ in range(1000):
        test.add(-5.0, 10.0)
    test.add(6.0, 10.0)
    assert not test.alarm
    test.add(6.0, 10.0)
    assert test.alarm


def test_an_alarm_ends_by_as_much_evidence_as_it_began_with() -> None:
    test = Cusum(alarm=True)
    test.add(-6.0, 10.0)
    assert test.alarm
    test.add(-6.0, 10.0)
    assert not test.alarm


@pytest.mark.parametrize("x", [-1.0, 0.0, 2.5])
def test_log_normal_is_the_log_of_the_density(x: float) -> None:
    assert np.exp(log_normal(x, 0.5, 2.0)) == pytest.approx(np.exp(-((x - 0.5) ** 2) / 8.0) / np.sqrt(8.0 * np.pi))
