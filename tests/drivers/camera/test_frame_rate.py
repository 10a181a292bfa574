"""Which frames are used, in simulated time: a camera, a mailbox of one, and a reader whose steps take so long."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ceilvo.drivers.camera.frame_rate import FrameRate, RateNews

SEED = 11
EXAMPLES = 30
"""Each is a minute or two of frames; chosen: a tenth of a second of work."""


@dataclass
class Drive:
    """What came of it: stamps of the used frames, their ages when their steps were done, what was said, and when."""

    used_s: list[float] = field(default_factory=list)
    age_s: list[float] = field(default_factory=list)
    said: list[tuple[float, RateNews]] = field(default_factory=list)

    def every(self, after_s: float, period_s: float) -> list[int]:
        """Frame periods between used frames."""
        gaps = np.diff([t for t in self.used_s if t >= after_s])
        return [round(g / period_s) for g in gaps]


def drive(
    rate: FrameRate, stamps_s: list[float], step_s: Callable[[float, int], float], into: Drive | None = None
) -> Drive:
    """step_s: of the time a step begins and of the rate's every_nth."""
    out, mail, done_s = into or Drive(), None, -math.inf
    busy_s: float | None = None
    for now_s in [*stamps_s, math.inf]:
        while True:
            if busy_s is not None and done_s < now_s:  # the reader comes back before this frame
                rate.stepped(busy_s)
                busy_s = None
            if busy_s is not None or mail is None or not rate.is_due(mail):
                break
            begins_s = max(done_s, 1e-9 * mail)
            busy_s = step_s(begins_s, rate.every_nth)
            done_s = begins_s + busy_s
            rate.used(mail)
            out.used_s.append(1e-9 * mail)
            out.age_s.append(done_s - 1e-9 * mail)
            mail = None
        if now_s == math.inf:
            return out
        mail = round(1e9 * now_s)
        rate.arrived(mail)
        while (news := rate.news()) is not None:
            out.said.append((now_s, news))
    return out


def even(period_s: float, seconds: float, from_s: float = 1.0) -> list[float]:
    return [from_s + period_s * k for k in range(math.ceil(seconds / period_s))]


def settled_s(period_s: float, step_s: float) -> float:
    """By which a rate has been chosen: six blocks, each half a second and the rest of a step or period long."""
    return 1.0 + 6.0 * (0.5 + 2.0 * max(period_s, step_s)) + 2.0 * period_s


periods = st.floats(1 / 240, 0.5)
loads = st.floats(0.05, 12.0).filter(lambda u: abs(u - round(u)) > 0.02)


@settings(max_examples=EXAMPLES, deadline=None)
@given(period_s=periods, load=loads)
def test_the_highest_rate_that_a_computer_keeps_up_with_is_taken_and_kept(period_s: float, load: float) -> None:
    step_s, n = load * period_s, math.ceil(load)
    assume(n <= 2 or n * period_s < 1.0)
    after_s = settled_s(period_s, step_s)
    got = drive(FrameRate(1 / period_s), even(period_s, after_s + 60.0 * n * period_s), lambda t, k: step_s)
    assert [news.kind for _, news in got.said] == ["rate"] * (n > 1)
    assert all(t <= after_s for t, _ in got.said)
    assert set(got.every(after_s + 2 * n * period_s, period_s)) == {n}
    assert max(got.age_s) <= period_s + step_s + 1e-6, "none waits for longer than the camera's period"


@settings(max_examples=EXAMPLES, deadline=None)
@given(period_s=periods, heavy=loads, light=loads, seconds=st.floats(0.0, 40.0))
def test_when_there_is_room_again_the_rate_rises_once(
    period_s: float, heavy: float, light: float, seconds: float
) -> None:
    light = min(heavy, light)
    assume(math.ceil(heavy) <= 2 or math.ceil(heavy) * period_s < 1.0)
    until_s = settled_s(period_s, heavy * period_s) + seconds

    def step_s(t_s: float, every: int) -> float:
        return period_s * (heavy if t_s < until_s else light)

    last_s = until_s + settled_s(period_s, heavy * period_s) + 20.0
    got = drive(FrameRate(1 / period_s), even(period_s, last_s + 60.0 * math.ceil(heavy) * period_s), step_s)
    n = set(got.every(last_s, period_s))
    assert len(n) == 1
    assert math.ceil(light) <= n.pop() <= max(math.ceil(light / 0.8), 1)
    said = [news.kind for _, news in got.said]
    assert said == sorted(said, reverse=True), "rate, then note: it does not swing"
    assert len(said) <= 3, "down, up half the way while blocks of both are known, up"


@settings(max_examples=EXAMPLES, deadline=None)
@given(
    period_s=st.floats(1 / 120, 1 / 15), at_s=st.lists(st.floats(2.0, 60.0), max_size=20), stall_s=st.floats(0.0, 5.0)
)
def test_steps_that_are_late_now_and_then_change_nothing(period_s: float, at_s: list[float], stall_s: float) -> None:
    """Two in three seconds, however long."""
    stalls = [t for k, t in enumerate(sorted(at_s)) if k < 2 or t - sorted(at_s)[k - 2] > 3.5 + 2 * stall_s]
    left = list(stalls)

    def step_s(t_s: float, every: int) -> float:
        if left and t_s >= left[0]:
            left.pop(0)
            return stall_s
        return 0.6 * period_s

    got = drive(FrameRate(1 / period_s), even(period_s, 70.0), step_s)
    assert got.said == []


def test_one_long_step_in_ten_is_no_reason_while_the_rest_leaves_room() -> None:
    count = 0

    def step_s(t_s: float, every: int) -> float:
        nonlocal count
        count += 1
        return 0.060 if count % 10 == 0 else 0.020

    got = drive(FrameRate(30.0), even(1 / 30, 60.0), step_s)
    assert got.said == []
    assert np.mean(np.array(got.every(5.0, 1 / 30)) == 1) > 0.9


def test_steps_that_get_shorter_when_there_are_fewer_do_not_make_it_swing() -> None:
    """A busy computer favours who sleeps: the rate is tried again, but ever less often."""
    got = drive(FrameRate(30.0), even(1 / 30, 3600.0), lambda t, every: 0.035 if every == 1 else 0.020)
    swings = [t for t, news in got.said if news.kind == "rate"]
    assert len(swings) < 20
    assert min(np.diff(swings)[-3:]) > 300.0


@settings(max_examples=10, deadline=None)
@given(
    period_s=st.floats(1 / 30, 1 / 8), heavy=st.floats(1.1, 6.0), on_s=st.floats(0.2, 40.0), off_s=st.floats(0.2, 40.0)
)
def test_others_that_come_and_go_change_the_rate_ever_less_often(
    period_s: float, heavy: float, on_s: float, off_s: float
) -> None:
    def step_s(t_s: float, every: int) -> float:
        return period_s * (heavy if t_s % (on_s + off_s) < on_s else 0.5)

    got = drive(FrameRate(1 / period_s), even(period_s, 600.0), step_s)
    lowered = [t for t, news in got.said if news.kind == "rate"]
    assert len(lowered) <= min(10, 2 + 600.0 / (on_s + off_s))
    assert max(got.age_s) <= (1.0 + heavy) * period_s + 1e-6
    assert max(got.every(0.0, period_s)) <= math.ceil(heavy) + 1, "poses come as often as steps allow"


def test_a_computer_that_hardly_moves_takes_the_newest_each_time_and_is_soon_better() -> None:
    rate, until_s = FrameRate(30.0), 80.0
    stamps = even(1 / 30, 100.0)
    got = drive(rate, stamps, lambda t, every: 4.0 if t < until_s else 0.01)
    assert max(got.age_s) <= 4.0 + 1 / 30 + 1e-6
    assert set(got.every(until_s + 14.0, 1 / 30)) == {1}, "4 s between two used frames would take 24 s to be left"
    assert [news.text.split(": ")[1] for _, news in got.said][:2] == [
        "one frame in 30 is used at most",
        "every frame is used",
    ]


def test_steps_that_vary_around_the_period_do_not_make_it_swing() -> None:
    rng = np.random.default_rng(SEED)
    got = drive(FrameRate(60.0), even(1 / 60, 1800.0), lambda t, every: float(rng.gamma(9.0, 1 / 60 / 9.0)))
    assert len(got.said) < 20, [t for t, _ in got.said]


@pytest.mark.parametrize("jitter", [0.1, 0.3])
def test_stamps_that_shake_leave_the_spacing_even(jitter: float) -> None:
    rng, p = np.random.default_rng(SEED), 1 / 90
    stamps = [t + float(rng.uniform(-jitter, jitter)) * p for t in even(p, 60.0)]
    got = drive(FrameRate(90.0), stamps, lambda t, every: 2.5 * p)
    gaps = np.diff([t for t in got.used_s if t > 10.0]) / p
    assert abs(np.mean(gaps) - 3.0) < 0.05
    assert np.abs(gaps - 3.0).max() <= 1.0 + 2 * jitter


def test_a_frame_that_the_driver_lost_costs_no_evenness() -> None:
    rng, p = np.random.default_rng(SEED), 1 / 60
    stamps = [t for t in even(p, 60.0) if rng.random() > 0.05]
    got = drive(FrameRate(60.0), stamps, lambda t, every: 2.5 * p)
    gaps = got.every(10.0, p)
    assert set(gaps) <= {3, 4, 5}
    assert np.mean(np.array(gaps) == 3) > 0.9


def test_what_is_said_has_the_figures() -> None:
    got = drive(FrameRate(60.0), even(1 / 60, 20.0), lambda t, every: 0.045)
    assert [news.text for _, news in got.said] == [
        "gives 60 frames per second, this computer does 22.2: one frame in 3 is used at most"
    ]


# --- a camera that is slower than it said


def test_a_slow_camera_is_told_once_and_so_is_its_end() -> None:
    rate = FrameRate(30.0)
    stamps = even(1 / 30, 10.0)
    stamps += even(0.5, 20.0, stamps[-1] + 0.5)
    again_s = stamps[-1]
    stamps += even(1 / 30, 70.0, again_s + 1 / 30)
    got = drive(rate, stamps, lambda t, every: 0.01)
    assert [(news.kind, news.text.split(":")[0]) for _, news in got.said] == [
        ("slow", "gives 2 frames per second, it said 30"),
        ("note", "gives 30 frames per second again"),
    ]
    assert got.said[0][0] < 13.0, "known after three of its frames"
    assert 60.0 < got.said[1][0] - again_s < 63.0, "a minute later, for it may be slow again"
    assert got.every(5.0, 1 / 30).count(15) >= 39, "all of them are used"


def test_dusk_is_told_in_steps() -> None:
    stamps = even(1 / 30, 5.0)
    while stamps[-1] < 300.0:
        stamps.append(stamps[-1] + min(1 / 30 * 1.02 ** max(stamps[-1] - 5.0, 0.0), 0.5))
    got = drive(FrameRate(30.0), stamps, lambda t, every: 0.01)
    assert {news.kind for _, news in got.said} == {"slow"}
    assert 2 <= len(got.said) <= 4
    rate_hz = float(got.said[-1][1].text.split()[1])
    assert 2.0 <= rate_hz < 4.0, "what was said last is at most twice what it gives"


def test_a_camera_that_flickers_between_two_rates_is_told_once() -> None:
    stamps = even(1 / 30, 5.0)
    while stamps[-1] < 600.0:
        stamps += even(1 / (20 if stamps[-1] % 8.0 < 4.0 else 30), 1.0, stamps[-1] + 1 / 30)
    got = drive(FrameRate(30.0), stamps, lambda t, every: 0.01)
    assert [news.kind for _, news in got.said] == ["slow"]


def test_a_slow_computer_uses_every_frame_of_a_camera_that_has_become_slow_and_fewer_again() -> None:
    """Every third frame of 60 Hz was every third of 2 Hz, until the rate might rise: 5 s to 5 min."""
    rate = FrameRate(60.0)
    stamps = even(1 / 60, 5.0)
    dark_s = stamps[-1]
    stamps += even(0.5, 20.0, dark_s + 0.5)
    light_s = stamps[-1]
    stamps += even(1 / 60, 1.2, light_s + 1 / 60)
    got = drive(rate, stamps, lambda t, every: 0.045)
    said = [(t, news) for t, news in got.said if t > dark_s]
    assert said[0][0] == said[1][0], "at once, however long a rate is kept"
    assert [(news.kind, news.text.split(": ")[1]) for _, news in said] == [
        ("slow", "automatic exposure in the dark, a slow bus, or a busy computer"),
        ("note", "every frame is used"),
        ("rate", "one frame in 3 is used at most"),
    ]
    assert sum(t > dark_s + 4.0 for t in got.used_s if t <= light_s) == 32, "all that came once its rate was known"
    assert rate.every_nth == 3


def test_a_camera_that_gives_more_than_it_says_is_measured() -> None:
    rate = FrameRate(30.0)
    got = drive(rate, even(1 / 60, 20.0), lambda t, every: 0.025)
    assert [news.text for _, news in got.said] == [
        "gives 60 frames per second, this computer does 40: one frame in 2 is used at most"
    ]
    assert abs(rate.used_period_s - 1 / 30) < 1e-6


@pytest.mark.parametrize("stall_s", [0.2, 2.0, 20.0])
def test_a_camera_that_stalls_is_not_slow(stall_s: float) -> None:
    stamps = even(1 / 30, 5.0)
    for _ in range(2):
        stamps += even(1 / 30, 0.2, stamps[-1] + stall_s)
    stamps += even(1 / 30, 5.0, stamps[-1] + 1 / 30)
    rate = FrameRate(30.0)
    got = drive(rate, stamps, lambda t, every: 0.01)
    assert got.said == []
    assert abs(rate.camera_hz - 30.0) < 1e-6


@pytest.mark.parametrize("told_hz", [2.0, 30.0])
def test_the_period_of_a_slow_camera_is_known_soon(told_hz: float) -> None:
    rate = FrameRate(told_hz)
    drive(rate, even(0.5, 3.5), lambda t, every: 0.01)
    assert abs(rate.used_period_s - 0.5) < 1e-9


def test_a_camera_that_begins_anew_is_measured_anew() -> None:
    rate = FrameRate(60.0)
    got = drive(rate, even(1 / 60, 10.0), lambda t, every: 0.045)
    assert rate.every_nth == 3
    rate.opened(30.0)
    assert (rate.camera_hz, rate.every_nth) == (30.0, 2), "how busy the computer is, is still known"
    drive(rate, even(1 / 30, 20.0, 20.0), lambda t, every: 0.045, got)
    assert rate.every_nth == 2
    assert [news.kind for _, news in got.said] == ["rate", "note"]
    rate.opened(60.0)
    news = rate.news()
    assert news is not None
    assert news.text.endswith("one frame in 3 is used at most"), "said although no frame came in between"
