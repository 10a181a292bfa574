"""Pictures come from a process of their own: the same ones, whatever becomes of it."""

from __future__ import annotations

import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from patience import until

from ceilvo import se2
from ceilvo.config import Config
from ceilvo.daemon.replay import pictures
from ceilvo.daemon.replay.drawing.innovations import innovations_px, within_reach
from ceilvo.daemon.replay.pictures import Pictures, drawn
from ceilvo.daemon.vision.finder.crossing_finder import CrossingFinder, View
from ceilvo.drivers.pictures import jpeg
from ceilvo.errors import CeilvoError
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Array, Frame, Landmarks

WORLD = World(WorldSpec(seed=11))
PYTHON = sys.executable
DAEMON = """
import pickle, sys, time
sys.executable = sys.argv[2]
from ceilvo.daemon.replay.pictures import Pictures
calibration, seen = pickle.load(open(sys.argv[1], "rb"))
made = Pictures(calibration)
made.jpeg(*seen)
print(made.pid, flush=True)
time.sleep(1000)
"""
DRAWS = """#!{python}
import os, runpy, sys
os.sched_setscheduler = lambda *_: None
del sys.argv[:2]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""
"""A Python for `-m` whose process is not idle: beside other busy tests it would wait 10 s for each start."""


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process gets what others leave, and tests leave nothing for long."""
    monkeypatch.setattr(pictures, "_ANSWER_S", 120.0)


@pytest.fixture
def at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For all but the first of these tests, which has it as idle as it is."""
    path = tmp_path / "python"
    path.write_text(DRAWS.format(python=sys.executable))
    path.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(path))


@pytest.fixture(scope="module")
def seen() -> tuple[View, Landmarks, Array]:
    """A view, landmarks 4 mm off where its crossings are and some far away, and the pose."""
    finder, pose = CrossingFinder(WORLD.calibration, Config().features), np.asarray(WORLD.initial_pose, np.float64)
    frame = Frame(0, 10**9, WORLD.frame_at(0.0))
    finder(frame, None)
    view = finder.view
    assert view is not None and view.crossings is not None and len(view.crossings) > 10
    xy = se2.transform(pose, view.crossings.xy_base_m) + 0.004
    count = len(xy)
    kinds = np.tile(view.crossings.crossing_type, 2)
    cov = np.tile(np.eye(2) * 1e-6, (2 * count, 1, 1))
    return view, Landmarks(np.arange(2 * count), np.vstack([xy, xy + 50.0]), cov, kinds, np.full(2 * count, 5)), pose


@pytest.fixture
def made() -> Iterator[Pictures]:
    made = Pictures(WORLD.calibration)
    yield made
    made.close()


def pixels(data: bytes) -> Any:
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def test_it_is_what_would_be_drawn_here(made: Pictures, seen: tuple[View, Landmarks, Array]) -> None:
    view, landmarks, pose = seen
    expected = drawn(view, landmarks, pose, WORLD.calibration)
    for predicted, image in ((pose, expected), (None, drawn(view, landmarks, None, WORLD.calibration))):
        np.testing.assert_array_equal(pixels(made.jpeg(view, landmarks, predicted)), pixels(jpeg(image)))
    assert np.abs(expected.astype(int) - drawn(view, landmarks, None, WORLD.calibration)).max() > 50, "innovations"


def test_what_is_out_of_reach_draws_no_innovation(seen: tuple[View, Landmarks, Array]) -> None:
    view, landmarks, pose = seen
    assert view.crossings is not None
    near = within_reach(view.crossings, landmarks, pose)
    assert near.sum() == len(landmarks) // 2
    whole, part = (innovations_px(view.crossings, m, pose, WORLD.calibration) for m in (landmarks, landmarks.of(near)))
    np.testing.assert_array_equal(whole, part)
    assert np.isfinite(whole).all()


@pytest.mark.usefixtures("at_once")
def test_a_process_that_was_killed_comes_back(made: Pictures, seen: tuple[View, Landmarks, Array]) -> None:
    first = made.jpeg(*seen)
    assert made.pid is not None
    os.kill(made.pid, signal.SIGKILL)
    assert made.jpeg(*seen) == first


@pytest.mark.usefixtures("at_once")
def test_it_ends_when_nobody_asks_and_comes_back(seen: tuple[View, Landmarks, Array]) -> None:
    made = Pictures(WORLD.calibration, idle_s=0.2)
    with closing(made):
        first = made.jpeg(*seen)
        until(lambda: made.pid is None, "nobody asks any more")
        assert made.jpeg(*seen) == first


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Starts the process for each connection, as systemd does; the processes so far."""
    path, started = tmp_path / "socket", list[subprocess.Popen[bytes]]()
    monkeypatch.setenv("CEILVO_PICTURES", str(path))
    pids: list[int] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(path))
        listener.listen()

        def serve() -> None:
            while True:
                try:
                    connection, _ = listener.accept()
                except OSError:
                    return
                with connection:
                    words = [sys.executable, "-m", "ceilvo.daemon.replay.pictures", "0", "0.2"]
                    started.append(subprocess.Popen(words, stdin=connection))
                    pids.append(started[-1].pid)

        thread = threading.Thread(target=serve)
        thread.start()
        yield pids
        listener.shutdown(socket.SHUT_RDWR)
        thread.join()
    for process in started:
        process.wait()


@pytest.mark.usefixtures("at_once")
def test_behind_a_socket_it_is_the_same(manager: list[int], seen: tuple[View, Landmarks, Array]) -> None:
    view, landmarks, pose = seen
    made = Pictures(WORLD.calibration)
    with closing(made):
        first = made.jpeg(*seen)
        np.testing.assert_array_equal(pixels(first), pixels(jpeg(drawn(view, landmarks, pose, WORLD.calibration))))
        until(lambda: is_zombie(manager[0]), "nobody asks any more")
        assert made.jpeg(*seen) == first
        assert len(manager) == 2 and made.pid is None, "no child"


@pytest.mark.usefixtures("at_once")
def test_where_nothing_listens_it_is_a_child(
    made: Pictures, seen: tuple[View, Landmarks, Array], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CEILVO_PICTURES", str(tmp_path / "nobody"))
    assert made.jpeg(*seen)[:2] == b"\xff\xd8" and made.pid is not None


@pytest.mark.usefixtures("at_once")
def test_it_ends_with_its_daemon_however_that_ends(seen: tuple[View, Landmarks, Array], tmp_path: Path) -> None:
    given = tmp_path / "given"
    given.write_bytes(pickle.dumps((WORLD.calibration, seen)))
    words = [PYTHON, "-c", DAEMON, str(given), sys.executable]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as daemon:
        assert daemon.stdout is not None
        pid = int(daemon.stdout.readline())
        os.kill(pid, 0)
        daemon.kill()
    until(lambda: not Path(f"/proc/{pid}/cmdline").exists() or is_zombie(pid), "it has ended")


def is_zombie(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_one_that_cannot_begin_is_one_line(
    made: Pictures, seen: tuple[View, Landmarks, Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(CeilvoError, match=r"^picture: the process that draws ended twice: "):
        made.jpeg(*seen)
