"""CaptureLoop when its camera is lost: said once, opened again with growing waits, only the same one taken back."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable

import numpy as np
from capture_rig import FAST, Gate, Rig, collect
from patience import PATIENCE_S

from ceilvo import config
from ceilvo.drivers.camera.capture import CaptureLoop
from ceilvo.drivers.camera.mock_camera import Good, Loss, MockCamera, Stall, Step, Timeout
from ceilvo.drivers.ports import CameraInfo


def test_loss_and_return(start: Callable[..., Rig], gate: Gate) -> None:
    rig = start([Good(2), Loss(failed_opens=3)])
    before = collect(rig, gate, 2)
    rig.until("lost")
    assert rig.until("opened").text == "mock camera again gives 64x48 at 30 Hz"
    after = collect(rig, gate, 2)
    assert [f.seq for f in before + after] == [0, 1, 2, 3]
    assert (np.diff([f.stamp_ns for f in before + after]) > 0).all()
    counters = rig.loop.counters()
    assert (counters.losses, counters.reopens, counters.connected) == (1, 1, True)
    assert "no such device" in counters.last_error
    lost = [e.text for e in rig.seen if e.kind == "lost"]
    assert len(lost) == 2  # the loss, and once for the three openings that failed alike
    assert "lost while streaming" in lost[0]
    assert "no such device" in lost[1]


def test_absent_at_start(start: Callable[..., Rig], gate: Gate) -> None:
    rig = start([], failed_opens=2)
    assert "no such device" in rig.until("lost").text
    rig.until("opened")
    collect(rig, gate, 1)
    counters = rig.loop.counters()
    assert (counters.losses, counters.reopens, counters.connected) == (0, 0, True)


def test_a_timeout_is_a_loss(start: Callable[..., Rig], gate: Gate) -> None:
    rig = start([Good(1), Timeout(1.0)])
    collect(rig, gate, 1)
    gate.allow()
    assert "no frame within 1 s" in rig.until("lost").text
    rig.until("opened")
    assert collect(rig, gate, 1)[0].seq == 1


def test_a_stall_is_not_a_loss(start: Callable[..., Rig], gate: Gate) -> None:
    rig = start([Good(1), Stall(0.5)])
    collect(rig, gate, 3)
    assert rig.loop.counters().losses == 0


class RecordingEvent(threading.Event):
    """Notes how long the loop wants to wait, does not wait, and stops the loop after `last` times."""

    def __init__(self, last: int) -> None:
        super().__init__()
        self.waits: list[float] = []
        self._last = last

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.waits.append(timeout)
        if len(self.waits) == self._last:
            self.set()
        return self.is_set()


def run_with_recorded_waits(script: list[Step], last: int) -> list[float]:
    settings = config.Camera(reopen_min_s=0.2, reopen_max_s=1.0)
    loop = CaptureLoop(MockCamera(script, wait=lambda _: None), settings, lambda: 0)
    stopping = RecordingEvent(last)
    loop._stopping = stopping
    loop.start()
    loop._thread.join(PATIENCE_S)
    assert not loop._thread.is_alive()
    return stopping.waits


def test_waits_grow_to_their_limit() -> None:
    assert run_with_recorded_waits([Loss(failed_opens=99)], 5) == [0.2, 0.4, 0.8, 1.0, 1.0]


def test_a_good_frame_makes_waits_short_again() -> None:
    script = [Loss(failed_opens=2), Good(1), Loss(failed_opens=9)]
    assert run_with_recorded_waits(script, 6) == [0.2, 0.4, 0.8, 0.2, 0.4, 0.8]


def test_a_camera_that_opens_but_never_delivers_is_not_hammered() -> None:
    assert run_with_recorded_waits([Loss()] * 9, 5) == [0.2, 0.4, 0.8, 1.0, 1.0]


def test_stop_does_not_wait_for_the_next_attempt(gate: Gate) -> None:
    rig = Rig(MockCamera([Loss(failed_opens=9)], wait=gate), config.Camera(reopen_min_s=3600.0, reopen_max_s=3600.0))
    rig.loop.start()
    rig.until("lost")
    assert rig.loop.stop(PATIENCE_S)


def test_another_size_after_replugging_is_refused_until_the_right_one_is_back(
    start: Callable[..., Rig], gate: Gate
) -> None:
    rig = start([Good(1), Loss(width_px=32, height_px=24)])
    collect(rig, gate, 1)
    rig.until("lost")
    text = rig.until("lost").text
    assert "came back with 32x24, expected 64x48 as before" in text
    assert not rig.loop.counters().connected
    camera = rig.loop._camera
    assert isinstance(camera, MockCamera)
    camera._size = (64, 48)
    rig.until("opened")
    assert collect(rig, gate, 1)[0].gray.shape == (48, 64)


def test_another_camera_after_replugging_is_refused(start: Callable[..., Rig], gate: Gate) -> None:
    rig = start([Good(1), Loss(camera_id="other")])
    collect(rig, gate, 1)
    rig.until("lost")
    assert "came back as 'other', expected 'mock'" in rig.until("lost").text
    assert rig.loop.counters().reopens == 0


def test_numbers_increase_even_when_the_camera_starts_again_at_zero() -> None:
    class Forgetful(MockCamera):
        def open(self) -> CameraInfo:
            self._seq = 0
            return super().open()

    gate = Gate()
    rig = Rig(Forgetful([Good(3), Loss()], wait=gate))
    rig.loop.start()
    frames = collect(rig, gate, 5)
    assert [f.seq for f in frames] == [0, 1, 2, 3, 4]
    gate.opened.set()
    assert rig.loop.stop(PATIENCE_S)


def test_settings_with_a_longest_wait_below_the_first_are_survived() -> None:
    settings = dataclasses.replace(FAST, reopen_min_s=0.002, reopen_max_s=0.001)
    rig = Rig(MockCamera([Loss(failed_opens=4)], wait=lambda _: None), settings)
    rig.loop.start()
    rig.take()
    assert rig.loop.stop(PATIENCE_S)
