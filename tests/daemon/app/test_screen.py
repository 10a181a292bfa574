"""The live screen: fixed size whatever it is given, figures and map where they belong, drawn no more than it should."""

from __future__ import annotations

import io
import math
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from ceilvo.daemon.app.screen import HEIGHT, WIDTH, Screen, plot, render, status_line
from ceilvo.daemon.app.telemetry import ShownBase, Snapshot
from ceilvo.types import State

RUNNING = Snapshot(
    title="ceilvo robot1",
    state=State.TRACKING,
    reason="5 good frames in a row",
    quality=0.87,
    uptime_s=3725.0,
    pose=np.array([1.234, -0.5, math.radians(90)]),
    sigma=np.array([0.004, 0.005, math.radians(0.2)]),
    truth=np.array([1.231, -0.504, math.radians(89.5)]),
    fps=29.97,
    frames=1234,
    drops=2,
    latency_ms={"features": (5.1, 7.9), "total": (7.6, 12.3)},
    ess_ratio=0.63,
    unique_ancestors=41,
    particles=100,
    nis=1.04,
    landmarks=81,
    crossings=26,
    inliers=22,
    base=ShownBase(0.012, 813, 4),
    zenoh_samples=1201,
    landmarks_xy_m=np.array([[0.0, 0.0], [2.0, 2.0]]),
    path_xy_m=np.array([[0.0, -0.5], [0.5, -0.5]]),
    room_m=(-2.5, -2.5, 2.5, 2.5),
    events=("first", "second", "third", "fourth"),
)


@pytest.mark.parametrize(("elsewhere", "shown"), [(0.0, "100 %"), (1.5e-8, "100 %"), (1e-3, "99.9 %"), (0.27, "73 %")])
def test_how_likely_this_place_is_is_on_the_screen(elsewhere: float, shown: str) -> None:
    text = "\n".join(drawn(replace(RUNNING, unique_ancestors=None, elsewhere=elsewhere)))
    assert f"63 % ESS, {shown} in one place" in text


def drawn(snapshot: Snapshot, unicode: bool = True) -> list[str]:
    """Lines as an 80-column terminal gets them."""
    console = Console(file=io.StringIO(), width=WIDTH, height=24, record=True, force_terminal=True)
    console.print(render(snapshot, unicode))
    return console.export_text().splitlines()


def test_figures_are_on_the_screen() -> None:
    lines = drawn(RUNNING)
    text = "\n".join(lines)
    assert lines[0].startswith("ceilvo robot1  TRACKING      5 good frames in a row")
    assert lines[0].endswith("1:02:05")
    for expected in (
        "1.234 ± 0.004 m",
        "-0.500 ± 0.005 m",
        "90.00 ± 0.20 deg",
        "5.0 mm, +0.500 deg",
        "0.87",
        "30.0 fps, 2 dropped",
        "26 crossings, 22 inliers",
        "63 % ESS, 41 of 100 kept",
        "81 landmarks, NIS 1.04",
        "12 ms ago, 813 sent, 4 bad",
        "1201 samples",
        "features    5.1  7.9  total       7.6 12.3",
    ):
        assert expected in text
    assert "first" not in text  # only the newest events
    assert [line for line in lines if line in ("second", "third", "fourth")] == ["second", "third", "fourth"]


def test_what_is_off_or_unknown_says_so() -> None:
    text = "\n".join(drawn(Snapshot(base=ShownBase())))
    assert "unknown" in text
    assert "silent, 0 sent" in text
    assert text.count(" off") == 1


def test_ascii_terminals_get_ascii() -> None:
    assert "\n".join(drawn(replace(RUNNING, title="Prüfstand"), unicode=False)).isascii()


def test_wide_characters_do_not_push_the_layout() -> None:
    console = Console(file=io.StringIO(), width=200, height=24, force_terminal=True)
    lines = console.render_lines(render(replace(RUNNING, reason="天井が見えない", events=("天\x1b[2J",))), pad=False)
    assert max(sum(segment.cell_length for segment in line) for line in lines) == WIDTH - 1


numbers = st.one_of(st.floats(-1e3, 1e3), st.floats(allow_nan=True, allow_infinity=True))
triples = st.tuples(numbers, numbers, numbers).map(np.array)
points = st.lists(st.tuples(numbers, numbers), max_size=5).map(lambda p: np.array(p, np.float64).reshape(-1, 2))
snapshots: st.SearchStrategy[Snapshot] = st.builds(
    Snapshot,
    title=st.text(max_size=60),
    state=st.sampled_from(State),
    reason=st.text(max_size=200),
    uptime_s=st.floats(0, 1e8),
    pose=triples,
    sigma=triples,
    truth=st.none() | triples,
    fps=st.floats(0, 1e4),
    drops=st.integers(0, 10**9),
    latency_ms=st.dictionaries(st.text(max_size=20), st.tuples(st.floats(0, 1e6), st.floats(0, 1e6)), max_size=14),
    ess_ratio=st.floats(0, 1),
    elsewhere=st.floats(0, 1),
    nis=numbers,
    base=st.none() | st.builds(ShownBase, st.none() | st.floats(0, 1e6), st.integers(0, 10**9), st.integers(0, 10**9)),
    zenoh_samples=st.none() | st.integers(0, 10**12),
    landmarks_xy_m=st.none() | points,
    path_xy_m=st.none() | points,
    events=st.lists(st.text(max_size=200), max_size=6).map(tuple),
)


@settings(deadline=None, max_examples=80)
@given(snapshots, st.booleans())
def test_the_layout_never_moves(snapshot: Snapshot, unicode: bool) -> None:
    """As many lines, and the plot's frame in the same column, whatever is shown."""
    text = render(snapshot, unicode)
    lines = text.plain.split("\n")
    corner, side = ("┌", "│") if unicode else ("+", "|")
    assert len(lines) == HEIGHT
    assert lines[1][45] == lines[17][45].replace("└", "┌") == corner
    assert all(line[45] == line[78] == side for line in lines[2:17])
    assert all(len(line) < WIDTH for line in lines)
    assert all(c.isprintable() for line in lines for c in line)


@pytest.mark.parametrize(("width", "height"), [(80, 24), (60, 12), (200, 60)])
def test_other_terminal_sizes_crop_and_do_not_wrap(width: int, height: int) -> None:
    console = Console(file=io.StringIO(), width=width, height=height, force_terminal=True)
    lines = console.render_lines(render(RUNNING), pad=False)
    assert len(lines) == HEIGHT
    assert all(sum(segment.cell_length for segment in line) <= width for line in lines)


def at(lines: list[str], sign: str) -> tuple[int, int]:
    rows = [k for k, line in enumerate(lines) if sign in line]
    assert len(rows) == 1
    return lines[rows[0]].index(sign), rows[0]


@pytest.mark.parametrize(
    ("pose", "sign", "column", "row"),
    [
        ((0.01, -0.01, 0.0), "→", 16, 8),
        ((0.99, -0.01, math.pi / 2), "↑", 25, 8),
        ((0.01, 0.99, math.pi), "←", 16, 3),
        ((-0.99, -0.99, -math.pi / 2), "↓", 6, 13),
        ((0.01, -0.01, -0.75 * math.pi), "↙", 16, 8),
    ],
    ids=["centre", "x is right", "y is up", "both", "diagonal"],
)
def test_the_robot_is_drawn_where_it_is(pose: Any, sign: str, column: int, row: int) -> None:
    """30 x 15 cells over 3 m x 3 m: 0.1 m a column, 0.2 m a row; the frame takes one each side."""
    lines = plot(Snapshot(pose=np.array(pose), room_m=(-1.5, -1.5, 1.5, 1.5)), 32, 17)
    assert at(lines, sign) == (column, row)


def test_truth_landmarks_and_path_are_drawn() -> None:
    s = Snapshot(
        pose=np.array([0.05, 0.1, 0.0]),
        truth=np.array([1.05, 0.1, 0.0]),
        landmarks_xy_m=np.array([[-1.05, 1.1]]),
        path_xy_m=np.array([[-1.05, -1.1], [99.0, 0.0]]),
        room_m=(-1.5, -1.5, 1.5, 1.5),
    )
    lines = plot(s, 32, 17)
    robot, truth, landmark, path = (at(lines, sign) for sign in "→○·∙")
    assert (truth[0] - robot[0], truth[1] - robot[1]) == (10, 0)
    assert (landmark[0] - robot[0], landmark[1] - robot[1]) == (-11, -5)
    assert (path[0] - robot[0], path[1] - robot[1]) == (-11, 6)
    assert len({len(line) for line in lines}) == 1


def test_without_a_room_everything_seen_is_in_view() -> None:
    s = Snapshot(pose=np.array([12.0, 30.0, 0.0]), landmarks_xy_m=np.array([[-7.0, -9.0], [3.0, 31.0]]))
    text = "\n".join(plot(s, 34, 17))
    assert text.count("·") == 2
    assert text.count("→") == 1


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_four_times_a_second_and_no_thread() -> None:
    console = Console(file=io.StringIO(), width=80, height=24, force_terminal=True)
    clock, asked = Clock(), []
    threads = threading.active_count()

    def snapshot() -> Snapshot:
        asked.append(clock.now_s)
        return RUNNING

    with Screen(console, clock) as screen:
        assert threading.active_count() == threads
        for _ in range(100):
            screen.update(snapshot)
            clock.now_s += 0.01
    assert len(asked) == 4
    written = console.file.getvalue()  # type: ignore[attr-defined]
    assert written.startswith("\x1b[?1049h")
    assert "\x1b[?1049l" in written  # the terminal is given back
    assert "\x1b[?25h" in written  # with its cursor


def test_the_terminal_is_given_back_after_an_error() -> None:
    console = Console(file=io.StringIO(), width=80, height=24, force_terminal=True)
    with pytest.raises(RuntimeError, match="boom"), Screen(console, Clock()) as screen:
        screen.update(RUNNING)
        raise RuntimeError("boom")
    assert "\x1b[?1049l" in console.file.getvalue()  # type: ignore[attr-defined]


def test_without_a_terminal_a_plain_line_every_five_seconds() -> None:
    out = io.StringIO()
    clock = Clock()
    with Screen(Console(file=out, width=40, force_terminal=False), clock) as screen:
        assert screen.plain
        for _ in range(200):
            screen.update(RUNNING)
            clock.now_s += 0.1
    lines = out.getvalue().splitlines()
    assert len(lines) == 4  # not wrapped at 40 columns
    assert lines[0] == status_line(RUNNING)
    assert "\x1b" not in out.getvalue()


def test_status_line() -> None:
    assert status_line(RUNNING) == (
        " 3725.0 s TRACKING, x 1.234 y -0.500 m theta 90.0 deg, error 5 mm 0.50 deg, 30.0 fps, 2 dropped, "
        "base 813 sent, 4 failed"
    )
    assert status_line(Snapshot(state=State.LOST, reason="position sigma 0.8 m")).endswith("position sigma 0.8 m")


@pytest.mark.parametrize(
    ("ms", "text"), [(9.94, "  9.9"), (99.9, " 99.9"), (100.0, "  100"), (999.4, "  999"), (999.6, "  >1s")]
)
def test_figures_of_three_digits_do_not_merge(ms: float, text: str) -> None:
    s = replace(RUNNING, latency_ms={"photon_to_published": (ms, ms), "step": (ms, ms)})
    assert f"photon_...{text}{text}  step      {text}{text}" in render(s).plain


@pytest.mark.parametrize(("width", "height"), [(80, 23), (70, 23), (60, 15), (50, 23), (46, 12), (132, 42), (200, 59)])
def test_the_map_is_whole_in_every_terminal_and_grows_with_it(width: int, height: int) -> None:
    lines = render(RUNNING, True, width, height).plain.split("\n")
    assert len(lines) == height and all(len(line) <= max(width - 1, 44) for line in lines)
    frames = [line for line in lines if "┌" in line or "└" in line]
    if width - 1 - 45 < 12:
        assert not frames
        return
    assert len(frames) == 2 and all(line.rstrip()[-1] in "┐┘" and len(line.rstrip()) == width - 1 for line in frames)
    assert sum("│" in line for line in lines) == height - 8


def test_the_screen_asks_the_terminal_for_its_size() -> None:
    console = Console(file=io.StringIO(), width=132, height=40, force_terminal=True)
    with Screen(console, Clock()) as screen:
        screen.update(RUNNING)
    written = console.file.getvalue()  # type: ignore[attr-defined]
    assert "─" * 131 in written and written.count("│") == 2 * (39 - 8)
