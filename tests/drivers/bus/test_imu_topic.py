"""A gyro on Zenoh: what is integrated, and what is refused."""

from __future__ import annotations

import json
import math

import pytest

from ceilvo.drivers.bus.imu_topic import MAX_BYTES, ImuTopic

NOISE = 3e-8


class Clock:
    ns = 10**10

    def __call__(self) -> int:
        return self.ns


def filled(hz: float = 100.0, seconds: float = 2.0) -> ImuTopic:
    """Turns at sin(t) rad/s, by samples with stamps."""
    clock = Clock()
    topic = ImuTopic(clock, NOISE)
    for k in range(round(hz * seconds)):
        clock.ns = 10**10 + round(1e9 * k / hz)
        assert topic.add(json.dumps({"stamp_ns": clock.ns, "yaw_rate_radps": math.sin(k / hz)}).encode())
    return topic


def at(s: float) -> int:
    return 10**10 + round(1e9 * s)


@pytest.mark.parametrize(("start", "end"), [(0.2, 1.5), (0.505, 0.538), (1.9, 2.05)])
def test_its_integral_is_the_turn(start: float, end: float) -> None:
    turn = filled().turn_between(at(start), at(end))
    assert turn is not None
    beyond_s = max(end - 1.99, 0.0)  # the last rate goes on there
    assert abs(turn.turned_rad - (math.cos(start) - math.cos(end))) < 1e-4 + beyond_s**2
    assert turn.span_s == pytest.approx(end - start)
    assert turn.var_rad2 == pytest.approx(NOISE * (end - start))
    assert turn.gained_mps is None


def test_what_samples_do_not_cover_is_not_told() -> None:
    topic = filled()
    assert topic.turn_between(at(-0.1), at(0.5)) is None
    assert topic.turn_between(at(1.0), at(2.5)) is None
    assert topic.turn_between(at(1.0), at(1.0)) is None


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"[]",
        b"{}",
        b'{"yaw_rate_radps": "fast"}',
        b'{"yaw_rate_radps": 1e9}',
        b'{"yaw_rate_radps": NaN}',
        b'{"yaw_rate_radps": 0.1, "stamp_ns": -5}',
        b'{"yaw_rate_radps": 0.1, "stamp_ns": 1}',
        b'{"yaw_rate_radps": 0.1, "stamp_ns": 99000000000}',
        b'{"yaw_rate_radps": 0.1, "ax_mps2": 1e9}',
        b" " * (MAX_BYTES + 1),
    ],
)
def test_what_is_no_sample_is_refused_and_counted(payload: bytes) -> None:
    topic = filled()
    taken = topic.taken
    assert not topic.add(payload)
    assert (topic.taken, topic.refused) == (taken, 1)


def test_a_gap_begins_anew_and_accelerations_are_gathered() -> None:
    clock = Clock()
    topic = ImuTopic(clock, NOISE)
    for s in (0.0, 0.01, 0.02, 1.0, 1.01, 1.02):
        clock.ns = at(s)
        topic.add(b'{"yaw_rate_radps": 1.0, "ax_mps2": 2.0}')
    assert topic.turn_between(at(0.01), at(1.01)) is None
    turn = topic.turn_between(at(1.0), at(1.02))
    assert turn is not None and turn.gained_mps is not None
    assert turn.turned_rad == pytest.approx(0.02)
    assert turn.gained_mps.tolist() == pytest.approx([0.04, 0.0])
