"""The bench of open pages: what it counts, and when it is content."""

from __future__ import annotations

import socket

import numpy as np

from ceilvo.bench.speed.pages import Stretch, _live, bars_of

RNG = np.random.default_rng(5)


def pairs(slower_ms: float, fewer_hz: float, count: int = 8) -> list[tuple[Stretch, Stretch]]:
    """Ages that scatter by 1 ms from stretch to stretch, rates by .01 Hz."""

    def stretch(ms: float, hz: float) -> Stretch:
        return Stretch(15.0 - hz + 0.01 * RNG.standard_normal(), 20.0 + ms, 40.0 + ms + RNG.standard_normal())

    return [(stretch(0.0, 0.0), stretch(slower_ms, fewer_hz)) for _ in range(count)]


def verdicts(slower_ms: float, fewer_hz: float) -> tuple[str, str]:
    rate, _, p99 = bars_of(pairs(slower_ms, fewer_hz))
    return rate.verdict, p99.verdict


def test_what_slows_a_robot_by_more_than_the_noise_is_a_miss() -> None:
    assert verdicts(5.0, 0.0)[1] == "MISS"
    assert verdicts(0.0, 0.2)[0] == "MISS"
    assert verdicts(-5.0, -0.2) == ("PASS", "PASS")


def test_connections_that_stay_are_counted_on_the_servers_side_only() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        assert _live(port) == 0
        with socket.create_connection(("127.0.0.1", port)), server.accept()[0]:
            assert _live(port) == 1
