"""The link thread over the mock, and once over a real pty. Waiting is on events of the mock, never on the clock."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from link_parts import SETTINGS, FakeClock, Watched, estimate, received, wait_more
from patience import PATIENCE_S

from ceilvo import config, se2
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.base.modbus import ModbusBase
from ceilvo.sim.base import SimBase
from ceilvo.types import State


def test_before_any_estimate_the_base_hears_init(base: Watched, link: BaseLink) -> None:
    link.start()
    assert base.model.wait_received(3)
    for t in received(base)[:3]:
        assert (t.state, t.quality, t.sequence, t.age_s) == (State.INIT, 0.0, 0, 65.535)


def test_the_estimate_is_sent_and_repeated_with_age_and_heartbeat_growing(base: Watched) -> None:
    clock = FakeClock()
    link = BaseLink(SETTINGS, base, clock=clock)
    link.submit(estimate(3, clock.now_ns - 20_000_000))
    link.start()
    assert base.model.wait_received(2)
    clock.now_ns += 500_000_000
    wait_more(base)
    assert link.stop()
    telegrams = received(base)
    assert {t.sequence for t in telegrams} == {3}
    assert abs(telegrams[0].age_s - 0.020) < 1e-9
    assert abs(telegrams[-1].age_s - 0.520) < 1e-9
    assert [t.heartbeat for t in telegrams] == list(range(1, len(telegrams) + 1))


def test_newest_wins_and_a_stuck_line_does_not_hold_submit(base: Watched, link: BaseLink) -> None:
    base.gate.clear()
    link.submit(estimate(1))
    link.start()
    base.wait(lambda: base.exchanges == 1)
    for seq in (2, 3, 4, 5):
        link.submit(estimate(seq))
    assert base.exchanges == 1, "the line was not stuck while submitting"
    base.gate.set()
    assert base.model.wait_received(2)
    assert [t.sequence for t in received(base)][:2] == [1, 5]


def test_stop_sends_a_last_telegram_that_says_so(base: Watched) -> None:
    link = BaseLink(SETTINGS, base, clock=FakeClock())
    link.submit(estimate(8))
    link.start()
    assert base.model.wait_received(2)
    assert link.stop()
    *before, last = received(base)
    assert {t.state for t in before} == {State.TRACKING}
    assert (last.state, last.quality, last.sequence) == (State.STOPPED, 0.0, 8)
    assert last.heartbeat == before[-1].heartbeat + 1
    assert not base.model.motors_on
    assert not base.is_open


def test_stop_with_another_final_state(base: Watched) -> None:
    link = BaseLink(SETTINGS, base, clock=FakeClock())
    link.start()
    assert base.model.wait_received(1)
    assert link.stop(final_state=State.LOST)
    assert received(base)[-1].state is State.LOST


def test_stop_without_start_and_with_an_absent_base(base: Watched) -> None:
    assert BaseLink(SETTINGS, base).stop()
    base.present = False
    link = BaseLink(SETTINGS, base)
    link.start()
    base.wait(lambda: base.opens >= 2)
    assert link.stop()
    assert base.exchanges == 0


def test_stop_while_the_line_is_stuck_gives_up(base: Watched, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ceilvo.drivers.base.link._JOIN_S", 0.05)
    base.gate.clear()
    link = BaseLink(SETTINGS, base, clock=FakeClock())
    link.start()
    base.wait(lambda: base.exchanges == 1)
    assert link.stop() is False
    base.gate.set()
    assert link.stop()


def test_counters(base: Watched) -> None:
    clock = FakeClock()
    link = BaseLink(SETTINGS, base, clock=clock)
    empty = link.snapshot()
    assert (empty.up, empty.telegrams_sent, empty.link_age_s, empty.last_error, empty.status) == (
        False, 0, None, "", None,
    )  # fmt: skip
    link.start()
    assert base.model.wait_received(3)
    assert link.stop()
    clock.now_ns += 2_000_000_000
    after = link.snapshot()
    assert after.up
    assert after.telegrams_sent == base.model.received
    assert (after.telegrams_failed, after.reconnects, after.last_error) == (0, 0, "")
    assert after.link_age_s == pytest.approx(2.0)
    assert after.status is not None
    assert not after.status.motors_on, "the last telegram was STOPPED"
    assert not after.status.heartbeat_lost
    assert empty.telegrams_sent == 0, "a snapshot does not change"


def test_a_silent_base_counts_failures_and_the_port_is_reopened(base: Watched, link: BaseLink) -> None:
    base.model.faults.silent = True
    link.start()
    base.wait(lambda: base.opens >= 2)
    snapshot = link.snapshot()
    assert not snapshot.up
    assert snapshot.telegrams_failed >= 5
    assert "no answer" in snapshot.last_error
    base.model.faults.silent = False
    assert base.model.wait_received(2)
    snapshot = link.snapshot()
    assert snapshot.up
    assert snapshot.reconnects >= 1
    assert "no answer" in snapshot.last_error, "the last error is kept for the reader"


def test_unplugged_and_plugged_in_again(base: Watched, link: BaseLink) -> None:
    link.submit(estimate(1))
    link.start()
    assert base.model.wait_received(2)
    base.present = False
    opens = base.opens
    base.wait(lambda: base.opens >= opens + 2)
    failed = link.snapshot().telegrams_failed
    assert failed == 1, "nothing is sent while the port is closed"
    link.submit(estimate(9))
    base.present = True
    wait_more(base)
    assert received(base)[-1].sequence == 9
    assert link.snapshot().reconnects == 1


def test_logs_say_when_the_link_breaks_and_comes_back_once_each(
    base: Watched, link: BaseLink, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="ceilvo.base")
    link.start()
    assert base.model.wait_received(2)
    base.model.faults.silent = True
    exchanges = base.exchanges
    base.wait(lambda: base.exchanges >= exchanges + 10)
    base.model.faults.silent = False
    wait_more(base)
    assert link.stop()
    assert [r.levelname for r in caplog.records] == ["INFO", "WARNING", "INFO"]


def test_a_link_that_comes_and_goes_does_not_fill_the_log(
    base: Watched, link: BaseLink, caplog: pytest.LogCaptureFixture
) -> None:
    """It said `base link up` 581 times in 5 minutes."""
    caplog.set_level(logging.INFO, logger="ceilvo.base")
    link.start()
    for _ in range(40):
        base.model.faults.silent = True
        exchanges = base.exchanges
        base.wait(lambda before=exchanges: base.exchanges >= before + 2)
        base.model.faults.silent = False
        wait_more(base)
    assert link.stop()
    for level in (logging.INFO, logging.WARNING):
        said = [r.getMessage() for r in caplog.records if r.levelno == level]
        assert 5 <= len(said) <= 15, said


def test_the_rate_is_kept_when_estimates_come_faster(base: Watched) -> None:
    link = BaseLink(config.Base(port="mock", rate_hz=0.1), base, clock=FakeClock())
    link.start()
    assert base.model.wait_received(1)
    for seq in range(5):
        link.submit(estimate(seq))
    assert not base.model.wait_received(2, timeout_s=0.1)
    assert link.stop(), "stop does not wait for the period"
    assert [t.state for t in received(base)] == [State.INIT, State.STOPPED]


def test_an_unexpected_exception_is_reported(base: Watched) -> None:
    crashes: list[BaseException] = []
    crashed = threading.Event()

    def on_crash(e: BaseException) -> None:
        crashes.append(e)
        crashed.set()

    link = BaseLink(SETTINGS, base, clock=FakeClock(), on_crash=on_crash)
    link.start()
    assert base.model.wait_received(1)
    link.submit("not an estimate")  # type: ignore[arg-type]
    assert crashed.wait(PATIENCE_S)
    assert isinstance(crashes[0], AttributeError)
    assert link.stop()
    assert not base.is_open


def test_an_estimate_with_nan_reaches_the_base_as_lost(base: Watched, link: BaseLink) -> None:
    bad = estimate(4)
    bad.pose[0] = np.nan
    link.submit(bad)
    link.start()
    assert base.model.wait_received(1)
    assert (received(base)[0].state, received(base)[0].x_m) == (State.LOST, 0.0)


@pytest.mark.parametrize("function", ["fc23", "fc16_fc04"])
def test_over_a_pty_that_vanishes_and_returns_with_a_rebooted_base(tmp_path: Path, function: str) -> None:
    uptime_s = 0
    sim = SimBase(
        baud=1_000_000,
        turnaround_s=0.0,
        port_link=tmp_path / "tty-base",
        clock=lambda: time.monotonic_ns() + uptime_s * 1_000_000_000,
    )
    uptime_s = 3600
    sim.start()
    settings = config.Base(
        port=sim.port, baud=1_000_000, rate_hz=100.0, timeout_s=0.25, reconnect_max_s=0.05, function=function
    )
    link = BaseLink(settings, ModbusBase(settings))
    link.submit(estimate(1))
    link.start()
    assert sim.model.wait_received(5)
    sim.stop()
    sim.reboot()
    link.submit(estimate(2))
    sim.start()
    assert sim.model.wait_received(sim.model.received + 5)
    assert link.stop()
    snapshot = link.snapshot()
    sim.stop()
    assert snapshot.reconnects >= 1
    assert snapshot.telegrams_failed >= 1
    assert "lost" in snapshot.last_error or "cannot be opened" in snapshot.last_error
    assert [t.telegram.sequence for t in sim.telegrams][-1] == 2
    assert sim.telegrams[-1].telegram.state is State.STOPPED
    assert link.wheels.restarts == 1


def test_a_base_that_steers_gets_the_pose_of_now_with_the_age_of_the_picture(base: Watched) -> None:
    clock = FakeClock()
    base.model.version = 2
    settings = replace(SETTINGS, protocol=2, predict=True)
    link = BaseLink(settings, base, clock=clock)
    old = estimate(3, clock.now_ns - 100_000_000)
    link.submit(old)
    link.start()
    assert base.model.wait_received(1)
    assert link.stop()
    t = received(base)[0]
    there = se2.compose(old.pose, se2.driven(old.twist, np.array([0.1]))[0])
    assert np.allclose([t.x_m, t.y_m, t.theta_rad], there, atol=1e-4)
    assert (t.age_s, t.predicted_s, t.version) == (pytest.approx(0.1), pytest.approx(0.1), 2)
    assert t.sigma_x_m > 0.01
