from __future__ import annotations

import pytest

from ceilvo.config import Base
from ceilvo.config.serial_budget import bits_per_char, frame_gap_s, wire_budget


@pytest.mark.parametrize("parity", ["N", "E", "O"])
def test_a_character_is_eleven_bits(parity: str) -> None:
    assert bits_per_char(parity) == 11


def test_gap_is_fixed_above_19200_baud() -> None:
    assert frame_gap_s(19200, "E") == pytest.approx(38.5 / 19200)
    assert frame_gap_s(38400, "E") == 0.00175
    assert frame_gap_s(4_000_000, "E") == 0.00175


def test_fc23_by_hand() -> None:
    b = wire_budget(Base(baud=19200, turnaround_ms=3.0))
    assert (b.request_bytes, b.response_bytes, b.transactions) == (51, 25, 1)
    wire, gap = 76 * 11 / 19200, 38.5 / 19200
    assert b.cycle_s == pytest.approx(wire + 2 * gap + 0.003 + 88 / 19200)
    assert b.answer_s == pytest.approx(wire + gap + 0.003 + 88 / 19200)
    assert b.status_response_s == pytest.approx(25 * 11 / 19200)


def test_fc16_and_fc04_by_hand() -> None:
    b = wire_budget(Base(baud=115200, turnaround_ms=1.0, function="fc16_fc04"))
    assert (b.request_bytes, b.response_bytes, b.transactions) == (55, 33, 2)
    assert b.cycle_s == pytest.approx(88 * 11 / 115200 + 2 * (2 * 0.00175 + 0.001 + 0.002))
    assert b.answer_s == pytest.approx(55 * 11 / 115200 + 0.00175 + 0.001 + 0.002)


@pytest.mark.parametrize(
    ("baud", "rate_hz", "fits"),
    [(115200, 20.0, True), (115200, 70.0, False), (19200, 18.0, True), (19200, 20.0, False)],
)
def test_fits(baud: int, rate_hz: float, fits: bool) -> None:
    b = wire_budget(Base(baud=baud, rate_hz=rate_hz))
    assert b.fits is fits
    assert b.fits is (rate_hz <= b.max_rate_hz)
    assert f"/ {baud} baud" in b.arithmetic
    assert f"at most {b.max_rate_hz:.1f} Hz" in b.arithmetic
    assert "\n" not in b.arithmetic


@pytest.mark.parametrize(("timeout_s", "fits"), [(0.1, False), (0.11, True)])
def test_a_timeout_shorter_than_the_answer_does_not_fit(timeout_s: float, fits: bool) -> None:
    assert wire_budget(Base(baud=9600, rate_hz=5.0, timeout_s=timeout_s)).timeout_fits is fits
