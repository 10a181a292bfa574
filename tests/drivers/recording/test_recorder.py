"""The thread that records: a disk that hangs, is full or fails holds nobody up, and all that is lost is counted."""

from __future__ import annotations

import errno
import threading

import pytest
from patience import PATIENCE_S, until
from recording_messages import S, text

from ceilvo.drivers.recording.mcap_file import INPUT, Message
from ceilvo.drivers.recording.recorder import QUEUE_BYTES, Recorder


class Blocked:
    """A storage on a disk that hangs until it is let go."""

    retries, due = False, False

    def __init__(self) -> None:
        self.go, self.entered = threading.Event(), threading.Event()
        self.written: list[int] = []

    def write(self, message: Message) -> None:
        self.entered.set()
        assert self.go.wait(PATIENCE_S)
        self.written.append(message.number)

    def begin(self, now_ns: int) -> None: ...
    def fault(self, reason: str, now_ns: int) -> None: ...
    def tick(self, now_ns: int) -> None: ...
    def close(self) -> None: ...
    def abandon(self) -> None: ...
    def bytes_written(self) -> int:
        return 0


def test_a_disk_that_hangs_holds_nobody_up_and_drops_are_counted() -> None:
    """Nothing here could return if put() waited: the disk is let go only afterwards."""
    storage = Blocked()
    recorder = Recorder(storage, lambda: 0)
    recorder.start()
    recorder.put(text(0, {}, 0))
    assert storage.entered.wait(PATIENCE_S)
    for i in range(1, 200):
        recorder.put(text(0, {}, i), size=QUEUE_BYTES // 100)
    waiting = recorder.counters()
    assert waiting.dropped == 99 and waiting.messages == 0
    storage.go.set()
    assert recorder.stop()
    done = recorder.counters()
    assert storage.written == list(range(101))
    assert done.messages + done.dropped == 200


@pytest.mark.parametrize("why", ("hurry", "fault", "full", "end"))
def test_a_recorder_that_waits_for_the_first_pose_begins_when_there_is_a_reason_and_loses_nothing(why: str) -> None:
    storage = Blocked()
    storage.go.set()
    recorder = Recorder(storage, lambda: 0, patience_s=1e6)
    recorder.start()
    for i in range(3):
        recorder.put(text(0, {}, i))
    assert not storage.entered.wait(0.1), "it has begun"
    if why == "hurry":
        recorder.hurry()
    elif why == "fault":
        recorder.fault("of a test")
    elif why == "full":
        recorder.put(text(0, {}, 3), size=QUEUE_BYTES // 2 + 1)
    else:
        assert recorder.stop()
    assert storage.entered.wait(PATIENCE_S)
    assert recorder.stop()
    assert storage.written == list(range(4 if why == "full" else 3)) and recorder.counters().dropped == 0


def test_a_recorder_begins_by_itself_when_no_pose_comes() -> None:
    storage = Blocked()
    storage.go.set()
    recorder = Recorder(storage, lambda: 0, patience_s=0.05)
    recorder.start()
    recorder.put(text(0, {}, 0))
    assert storage.entered.wait(PATIENCE_S)
    assert recorder.stop()


class Failing(Blocked):
    """A disk that is full from the third message on, until it is not."""

    retries, full = True, True

    def write(self, message: Message) -> None:
        if self.full and len(self.written) >= 2:
            raise OSError(errno.ENOSPC, "No space left on device", "flight.mcap")
        self.written.append(message.number)


@pytest.mark.parametrize("retries", [False, True])
def test_a_full_disk_stops_the_recorder_and_nothing_else(retries: bool) -> None:
    storage, now_ns, told = Failing(), [0], threading.Semaphore(0)
    storage.retries = retries
    reasons: list[str] = []
    recorder = Recorder(storage, lambda: now_ns[0], lambda why: (reasons.append(why), told.release())[1])
    recorder.start()
    for i in range(5):
        recorder.put(text(0, {}, i))
    assert told.acquire(timeout=PATIENCE_S)
    assert reasons == ["No space left on device (flight.mcap)"]
    recorder.put(text(0, {}, 9))
    stopped = recorder.counters()
    assert stopped.stopped == reasons[0] and stopped.dropped >= 1
    storage.full = False
    now_ns[0] = 31 * S
    until(lambda: not recorder.counters().stopped or not retries)
    recorder.put(text(0, {}, 10))
    assert recorder.stop()
    assert storage.written == ([0, 1, 10] if retries else [0, 1])
    assert recorder.counters().messages + recorder.counters().dropped == 7


def test_a_mistake_in_the_recorder_is_told_and_stays_there(caplog: pytest.LogCaptureFixture) -> None:
    storage, told = Blocked(), threading.Event()
    storage.go.set()
    recorder = Recorder(storage, lambda: 0, lambda why: told.set())
    recorder.start()

    def wrong(unix_ns: int) -> bytes:
        raise ValueError("cannot be encoded")

    class Encoding(Blocked):
        def write(self, message: Message) -> None:
            message.data(0)

    storage.write = Encoding().write  # type: ignore[method-assign]
    recorder.put(Message(INPUT, 0, wrong))
    assert told.wait(PATIENCE_S)
    recorder.put(text(0, {}))
    assert recorder.counters().stopped == "ValueError: cannot be encoded"
    assert "cannot be encoded" in caplog.text


def test_a_recorder_outlives_a_storage_that_cannot_even_be_closed(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(Failing):
        def abandon(self) -> None:
            raise FileNotFoundError("gone")

    told = threading.Event()
    recorder = Recorder(Broken(), lambda: 0, lambda why: told.set())
    recorder.start()
    for i in range(5):
        recorder.put(text(0, {}, i))
    assert told.wait(PATIENCE_S)
    assert recorder.stop()
    assert "could not be closed" in caplog.text
