"""The estimator with three live pages of it open and with none: frame rate and age of poses, in paired stretches.

python -m ceilvo.bench.speed.pages --pairs 8 --seconds 20

The simulated robot and `ceilvod web`, at the priority of its unit, share one processor; three Chromiums, each with a
page on its screen, have the other, for they are on somebody's laptop. Programs on one processor slow another down by
the memory that they share, so the browsers are there in both stretches of a pair: in one they show this robot, in the
other one a second robot, which runs beside them. Which comes first changes from pair to pair. An age is from the
frame's stamp, the start of its exposure, until a subscriber has the pose.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track

from ceilvo.bench.results.bars import Bar, as_json, table
from ceilvo.bench.soak.parts import Listener, free_port
from ceilvo.errors import CeilvoError
from ceilvo.files import write_atomic
from ceilvo.types import Array

PAGES = 3
_CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
_SETTLED_S = 4.0
"""Before a stretch counts: pages load and subscribe, or are gone."""
_OPENED_S = 60.0
_WEB_NICE = 10
"""As systemd/ceilvo-web.service."""
_LISTENER_PRIORITY = 1
"""Of SCHED_FIFO: who takes the times must not wait for browsers, whose own priority is -8; chosen."""
_NS = 1e-9
_ESTABLISHED = "01"
"""In /proc/net/tcp."""


class Stretch(NamedTuple):
    """Poses in a second; median and 99 % of their age, ms."""

    rate_hz: float
    median_ms: float
    p99_ms: float


def main(arguments: Sequence[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="pages", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--pairs", type=int, default=8)
    p.add_argument("--seconds", type=float, default=20.0, help="of each stretch (%(default)s)")
    p.add_argument("--rate-hz", type=float, default=15.0, help="of the camera (%(default)s)")
    p.add_argument("--out", type=Path, default=Path("build/bench"))
    a = p.parse_args(arguments)
    a.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        pairs = measured(a.pairs, a.seconds, a.rate_hz, Path(folder))
    bars = bars_of(pairs)
    Console(width=110).print(table(bars, f"{PAGES} pages and none, {a.pairs} pairs of {a.seconds:g} s"))
    rows = [{"none": none._asdict(), "pages": pages._asdict()} for none, pages in pairs]
    write_atomic(a.out / "pages.json", json.dumps({"bars": as_json(bars), "pairs": rows}, indent=1) + "\n")
    return 0


def measured(count: int, seconds: float, rate_hz: float, folder: Path) -> list[tuple[Stretch, Stretch]]:
    """(without, with) of each pair.

    Raises:
        CeilvoError: there is no Chromium, or pages do not open.
    """
    own, others = _processors()
    os.sched_setaffinity(0, others)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_LISTENER_PRIORITY))
    pairs = []
    with (
        _robot(own, rate_hz, folder / "own") as (zenoh_port, web_port),
        _robot(others, rate_hz, folder / "other") as (_, other_web_port),
        contextlib.closing(Listener(zenoh_port)) as listener,
    ):
        if not listener.got_pose.wait(_OPENED_S):
            raise CeilvoError(f"pages: no pose within {_OPENED_S:g} s, expected the simulated robot's")
        for k in track(range(count), "pairs", console=Console(stderr=True)):
            got: dict[bool, Stretch] = {}
            for open_now in (k % 2 == 0, k % 2 == 1):
                with _pages(web_port if open_now else other_web_port, folder / f"{k}", others):
                    got[open_now] = _stretch(listener, seconds)
            pairs.append((got[False], got[True]))
    return pairs


def _processors() -> tuple[set[int], set[int]]:
    """The robot's, and those for all others; with one processor both are that."""
    first, *rest = sorted(os.sched_getaffinity(0))
    return {first}, set(rest) or {first}


@contextlib.contextmanager
def _robot(processors: set[int], rate_hz: float, folder: Path) -> Iterator[tuple[int, int]]:
    """A simulated robot and its pages' server; the ports of Zenoh and of the pages."""
    zenoh_port, web_port = free_port(), free_port()
    said = (f"zenoh.listen=[tcp/127.0.0.1:{zenoh_port}]", "zenoh.multicast=false", f"web.port={web_port}")
    more = (f"service.state_dir={folder}", f"camera.rate_hz={rate_hz:g}", f"web.state_dir={folder}")
    settings = [word for setting in (*said, *more) for word in ("--set", setting)]
    summary, program = ("--summary", str(folder / "summary.json")), (sys.executable, "-m", "ceilvo.daemon.cli")
    with (
        _program(processors, 0, *program, "run", "--simulate", *summary, *settings),
        _program(processors, _WEB_NICE, *program, "web", *settings),
    ):
        yield zenoh_port, web_port


@contextlib.contextmanager
def _program(processors: set[int], nice: int, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    pinned = ["chrt", "--other", "0", "taskset", "--cpu-list", ",".join(map(str, processors)), *words]
    process = subprocess.Popen(pinned, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, process.pid, nice)
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


@contextlib.contextmanager
def _pages(port: int, folder: Path, processors: set[int]) -> Iterator[None]:
    """Each in a browser of its own: pages that are hidden behind others ask for less."""
    program = next((found for name in _CHROMIUM if (found := shutil.which(name))), None)
    if program is None:
        raise CeilvoError("pages: found no chromium, expected it; apt install chromium")
    options = ("--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--window-size=1280,2400")
    with contextlib.ExitStack() as held:
        for n in range(PAGES):
            own = folder / f"{n}"
            words = (program, *options, "--remote-debugging-port=0", f"--user-data-dir={own}")
            held.enter_context(_program(processors, 0, *words, f"http://127.0.0.1:{port}/"))
        until_s = time.monotonic() + _OPENED_S
        while _live(port) < PAGES:
            if time.monotonic() > until_s:
                raise CeilvoError(f"pages: {_live(port)} pages have a connection after {_OPENED_S:g} s, expected 3")
            threading.Event().wait(0.2)
        yield


def _live(port: int) -> int:
    """Pages keep one connection, their websocket, for as long as they are open."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return sum(row[1].endswith(f":{port:04X}") and row[3] == _ESTABLISHED for row in rows)


def _stretch(listener: Listener, seconds: float) -> Stretch:
    threading.Event().wait(_SETTLED_S)
    begin_ns, skip = time.monotonic_ns(), len(listener.heard.poses)
    threading.Event().wait(seconds)
    span_s, poses = (time.monotonic_ns() - begin_ns) * _NS, listener.heard.poses[skip:]
    ages_ms = np.array([(p.recv_ns - p.stamp_ns) * 1e-6 for p in poses])
    return Stretch(len(poses) / span_s, float(np.median(ages_ms)), float(np.percentile(ages_ms, 99)))


def bars_of(pairs: Sequence[tuple[Stretch, Stretch]]) -> list[Bar]:
    """Differences within pairs, with pages less without; the noise is that of stretches without."""
    none, pages = (np.array([pair[i] for pair in pairs]) for i in (0, 1))
    bars = []
    for i, (name, unit) in enumerate((("frame rate", "Hz"), ("age, median", "ms"), ("age, 99 %", "ms"))):
        off, noise = pages[:, i] - none[:, i], float(np.std(none[:, i], ddof=1))
        mean, sigma = float(off.mean()), float(off.std(ddof=1) / np.sqrt(len(off)))
        text = f"{_mean(none, i)} -> {_mean(pages, i)} {unit}: {mean:+.2f} +- {sigma:.2f}; noise {noise:.2f}"
        low, high = (-noise, np.inf) if unit == "Hz" else (-np.inf, noise)
        bars.append(Bar(f"{name}, difference in {unit} within noise", mean, text, low, high))
    return bars


def _mean(columns: Array, i: int) -> str:
    return f"{columns[:, i].mean():.2f}"


if __name__ == "__main__":
    sys.exit(main())
