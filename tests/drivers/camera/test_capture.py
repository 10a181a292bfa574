"""CaptureLoop driven by scripts: the mailbox, frames that cannot be used, crash, end and stop."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from capture_rig import FAST, Gate, Rig, collect
from patience import PATIENCE_S

from ceilvo.drivers.camera.capture import CaptureEvent, CaptureLoop
from ceilvo.drivers.camera.mock_camera import (
    BadPicture,
    BadStamp,
    Crash,
    Good,
    Loss,
    MockCamera,
    Step,
    WrongSize,
    moving_square,
)
from ceilvo.drivers.camera.recorded import FolderCamera, write_folder
from ceilvo.errors import FileFormatError
from ceilvo.types import Frame

# --- the mailbox


def test_frames_in_order(start: Callable[..., Rig], gate: Gate) -> None:
    rig = start([])
    frames = collect(rig, gate, 5)
    assert [f.seq for f in frames] == [0, 1, 2, 3, 4]
    assert all(np.array_equal(f.gray, moving_square(f.seq, 64, 48)) for f in frames)
    counters = rig.loop.counters()
    assert (counters.frames, counters.drops, counters.bad_frames, counters.connected) == (5, 0, 0, True)
    assert rig.until("opened").text == "mock camera gives 64x48 at 30 Hz"


def test_newest_frame_wins_and_drops_are_counted(start: Callable[..., Rig], gate: Gate) -> None:
    # the sixth step fails, so when the loss is known five frames were read and nobody took one
    rig = start([Good(5), Loss()])
    gate.allow(5)
    rig.until("lost")
    assert rig.take().seq == 4
    assert (rig.loop.counters().frames, rig.loop.counters().drops) == (5, 4)


def test_a_frame_is_taken_once(start: Callable[..., Rig], gate: Gate) -> None:
    rig = start([])
    collect(rig, gate, 1)
    assert rig.loop.take(0.0) is None
    assert not rig.loop.finished


def test_take_wakes_up_when_a_frame_comes(start: Callable[..., Rig], gate: Gate) -> None:
    rig = start([])
    got: queue.Queue[Frame | None] = queue.Queue()
    taker = threading.Thread(target=lambda: got.put(rig.loop.take(PATIENCE_S)))
    taker.start()
    gate.allow()
    frame = got.get(timeout=PATIENCE_S)
    taker.join()
    assert frame is not None
    assert frame.seq == 0


# --- frames that cannot be used


@pytest.mark.parametrize(
    ("bad", "says", "stamps"),
    [
        (BadPicture(), "cut short", 0),
        (BadStamp(0), "is not after the last one", 1),
        (BadStamp(-5_000_000), "is not after the last one", 1),
        (WrongSize(32, 48), "frame of 32x48, expected 64x48", 0),
    ],
)
def test_a_bad_frame_is_left_out_and_counted(
    start: Callable[..., Rig], gate: Gate, bad: Step, says: str, stamps: int
) -> None:
    rig = start([Good(2), bad])
    before = collect(rig, gate, 2)
    gate.allow()
    assert says in rig.until("bad_frame").text
    after = collect(rig, gate, 2)
    assert (np.diff([f.seq for f in before + after]) > 0).all()
    assert (np.diff([f.stamp_ns for f in before + after]) > 0).all()
    counters = rig.loop.counters()
    assert (counters.frames, counters.bad_frames, counters.bad_stamps, counters.losses) == (4, 1, stamps, 0)
    assert says in counters.last_error


def test_a_row_of_bad_frames_is_said_once(start: Callable[..., Rig], gate: Gate) -> None:
    rig = start([BadPicture(), BadPicture(), BadPicture()])
    gate.allow(3)
    collect(rig, gate, 1)
    rig.until("bad_frame")
    assert rig.loop.counters().bad_frames == 3
    assert rig.events.empty()


def test_nothing_but_bad_frames_is_a_loss(start: Callable[..., Rig], gate: Gate) -> None:
    now = iter(range(0, 10**12, 400_000_000))
    rig = start([BadPicture()] * 20, loop_clock=lambda: next(now))  # 0.4 s a look at the clock, read_timeout_s = 1
    gate.allow(3)
    assert "no usable frame for 1 s: mock camera: frame cut short" in rig.until("lost").text
    assert rig.loop.counters().bad_frames == 3


# --- crash, end, stop


def test_a_crash_is_handed_on_and_ends_the_loop(start: Callable[..., Rig], gate: Gate) -> None:
    error = ZeroDivisionError("driver")
    rig = start([Good(1), Crash(error)])
    collect(rig, gate, 1)
    assert rig.crashes.get(timeout=PATIENCE_S) is error
    assert rig.loop.take(PATIENCE_S) is None  # at once: none will come
    assert not rig.loop.finished
    assert rig.loop.counters().last_error == "driver"
    assert not rig.loop.counters().connected


def test_a_listener_that_fails_is_a_crash(gate: Gate) -> None:
    crashes: queue.Queue[Exception] = queue.Queue()

    def fail(_event: CaptureEvent) -> None:
        raise RuntimeError("listener")

    loop = CaptureLoop(MockCamera(wait=gate), FAST, lambda: 0, fail, crashes.put)
    loop.start()
    assert str(crashes.get(timeout=PATIENCE_S)) == "listener"
    assert loop.stop(PATIENCE_S)


def test_stop_closes_the_camera(gate: Gate) -> None:
    camera = MockCamera(wait=gate)
    rig = Rig(camera)
    rig.loop.start()
    collect(rig, gate, 1)
    gate.opened.set()
    assert rig.loop.stop(PATIENCE_S)
    assert camera.opens == 1
    assert camera.closes >= 1
    assert rig.loop.stop(PATIENCE_S)
    rig.loop.take(0.0)
    assert rig.loop.take(PATIENCE_S) is None


def test_stop_before_start_is_no_error() -> None:
    assert CaptureLoop(MockCamera(), FAST, lambda: 0).stop(PATIENCE_S)


def test_stop_says_when_the_driver_is_stuck(gate: Gate) -> None:
    rig = Rig(MockCamera(wait=gate))
    rig.loop.start()
    rig.until("opened")
    assert not rig.loop.stop(0.01)
    gate.opened.set()
    assert rig.loop.stop(PATIENCE_S)


def test_a_recording_loses_nothing_however_slowly_it_is_taken(tmp_path: Path) -> None:
    written = [Frame(i, 1000 + i, moving_square(i, 32, 24)) for i in range(25)]
    write_folder(tmp_path, written)
    rig = Rig(FolderCamera(tmp_path))
    rig.loop.start()
    taken = []
    while (frame := rig.loop.take(PATIENCE_S)) is not None:
        taken.append(frame)
    assert [(f.seq, f.stamp_ns) for f in taken] == [(f.seq, f.stamp_ns) for f in written]
    assert all(np.array_equal(a.gray, b.gray) for a, b in zip(taken, written, strict=True))
    assert rig.loop.finished
    assert rig.until("finished").text.endswith("end after 25 frames")
    counters = rig.loop.counters()
    assert (counters.frames, counters.drops, counters.connected) == (25, 0, False)
    assert rig.loop.stop(PATIENCE_S)


def test_not_finished_while_the_last_frame_waits() -> None:
    rig = Rig(MockCamera([Good(1)], live=False, wait=lambda _: None))
    rig.loop.start()
    rig.until("finished")
    assert not rig.loop.finished
    rig.take()
    assert rig.loop.finished
    assert rig.loop.stop(PATIENCE_S)


def test_stop_while_a_recording_waits_to_be_taken() -> None:
    rig = Rig(MockCamera([Good(9)], live=False, wait=lambda _: None))
    rig.loop.start()
    rig.until("opened")
    assert rig.loop.stop(PATIENCE_S)
    assert not rig.loop.finished
    assert rig.loop.counters().drops == 0


def test_a_damaged_recording_ends_the_loop_with_its_reason(tmp_path: Path) -> None:
    write_folder(tmp_path, [Frame(i, 1000 + i, moving_square(i, 32, 24)) for i in range(3)])
    (tmp_path / "000002.png").write_bytes(b"damage")
    rig = Rig(FolderCamera(tmp_path))
    rig.loop.start()
    assert [rig.take().seq, rig.take().seq] == [0, 1]
    assert rig.loop.take(PATIENCE_S) is None
    error = rig.crashes.get(timeout=PATIENCE_S)
    assert isinstance(error, FileFormatError)
    assert "line 4" in str(error)
    assert not rig.loop.finished
    assert rig.loop.stop(PATIENCE_S)


def test_notes_of_the_camera_are_said_once_an_opening(tmp_path: Path) -> None:
    import cv2

    cv2.imwrite(str(tmp_path / "a.png"), moving_square(0, 32, 24))
    rig = Rig(FolderCamera(tmp_path))
    rig.loop.start()
    assert "stamps assume 30 frames per second" in rig.until("note").text
    assert rig.loop.info is not None
    assert rig.loop.stop(PATIENCE_S)
