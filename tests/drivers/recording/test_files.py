"""MCAP files as written: read by other people's readers, cut anywhere, damaged anywhere; the ring and what it keeps."""

from __future__ import annotations

import errno
import json
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Schema
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from ceilvo.config import Recorder as RecorderConfig
from ceilvo.drivers.recording import foxglove
from ceilvo.drivers.recording.mcap_file import CALIBRATION, CONFIG, FRAMES, HEALTH, INPUT, Head, McapFile, Message
from ceilvo.drivers.recording.mcap_reader import open_recording
from ceilvo.drivers.recording.recorder import QUEUE_BYTES, Recorder
from ceilvo.drivers.recording.storage import Ring, SingleFile
from ceilvo.errors import FileFormatError

S = 1_000_000_000
UNIX_NS = 1_700_000_000 * S
SEED = 20261121
HEAD = Head({"robot": "r", "kind": "recording"}, {CONFIG: b"camera: {}\n", CALIBRATION: b"version: 1\n"}, UNIX_NS)


def text(stamp_ns: int, body: object, number: int = 0) -> Message:
    return Message(HEALTH, stamp_ns, lambda _: json.dumps(body).encode(), number)


def noise(seed: int, height: int = 48, width: int = 64) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width), np.uint8)


def picture(stamp_ns: int, number: int) -> Message:
    return Message(FRAMES, stamp_ns, lambda unix_ns: foxglove.raw_image(unix_ns, noise(number), "camera"), number)


def written(path: Path, count: int = 40, raw: bool = False) -> Path:
    file = McapFile(path, Head(HEAD.metadata, HEAD.attachments, UNIX_NS, raw_frames=raw), 0, start="fresh")
    for i in range(count):
        file.write(picture(i * S // 10, i))
        file.write(text(i * S // 10, {"i": i}, i))
        file.tick(i * S // 10)
    file.close()
    return path


# -- messages


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**33 * S), st.integers(0, 2**32 - 1))
def test_pictures_are_what_protocol_buffers_decode(width: int, height: int, unix_ns: int, seed: int) -> None:
    gray = noise(seed, height, width)
    for name, schema, data in (
        ("RawImage", foxglove.RAW_IMAGE_SCHEMA, foxglove.raw_image(unix_ns, gray, "camera")),
        ("CompressedImage", foxglove.COMPRESSED_IMAGE_SCHEMA, foxglove.compressed_image(unix_ns, b"x", "jpeg", "c")),
    ):
        decode = DecoderFactory().decoder_for("protobuf", Schema(1, schema, "protobuf", f"foxglove.{name}"))
        assert decode is not None
        m = decode(data)
        assert m.timestamp.seconds * S + m.timestamp.nanos == unix_ns
    assert (m.format, m.frame_id, m.data) == ("jpeg", "c", b"x")
    np.testing.assert_array_equal(foxglove.read_raw_image(foxglove.raw_image(unix_ns, gray, "")), gray)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_picture_or_our_error(data: bytes) -> None:
    for read in (foxglove.read_raw_image, foxglove.read_compressed_image):
        try:
            assert read(data).dtype == np.uint8
        except FileFormatError as e:
            assert "damaged" in str(e)


# -- files


@pytest.mark.parametrize("raw", [False, True], ids=["zstd", "lz4"])
def test_the_mcap_library_reads_all_of_it(tmp_path: Path, raw: bool) -> None:
    path = written(tmp_path / "a.mcap", raw=raw)
    with path.open("rb") as f:
        reader = make_reader(f, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 80 and summary.statistics.attachment_count == 2
        assert {a.name for a in reader.iter_attachments()} == {CONFIG, CALIBRATION}
        frames = [d.decoded_message for d in reader.iter_decoded_messages(topics=["/camera"])]
        assert [(m.width, m.height, m.encoding) for m in frames] == [(64, 48, "mono8")] * 40
        np.testing.assert_array_equal(np.frombuffer(frames[7].data, np.uint8).reshape(48, 64), noise(7))
        schemas = {s.name: s for s in summary.schemas.values()}
        assert json.loads(schemas["ceilvo.health.1"].data)["properties"] == {"i": {"type": "number"}}
    with path.open("rb") as f:
        assert sum(1 for _ in StreamReader(f, validate_crcs=True).records) > 80


def test_a_chunk_ends_every_second_so_that_little_is_lost(tmp_path: Path) -> None:
    """What was written more than a second ago is in the file of a process that is killed now."""
    file = McapFile(tmp_path / "a.mcap", HEAD, 0)
    for i in range(100):
        file.write(text(i * S // 10, {"i": i}, i))
        file.tick(i * S // 10)
        on_disk = [m.number for m in open_recording(tmp_path / "a.mcap").messages()]
        assert on_disk == list(range(len(on_disk))) and len(on_disk) >= i - 10
    file.abandon()


def test_a_recording_cut_anywhere_gives_all_that_was_before(tmp_path: Path) -> None:
    path = written(tmp_path / "whole.mcap", raw=True)
    data = path.read_bytes()
    whole = list(open_recording(path).messages())
    rng = np.random.default_rng(SEED)
    print("seed", SEED)
    head = max(i for i in range(2000) if not _opens(tmp_path, data[:i]))
    before = -1
    for cut in sorted({head + 1, len(data) - 1, *rng.integers(head + 1, len(data), 120).tolist()}):
        (tmp_path / "cut.mcap").write_bytes(data[:cut])
        recording = open_recording(tmp_path / "cut.mcap")
        found = list(recording.messages())
        assert found == whole[: len(found)]
        assert "ends in the middle" in recording.problem or found == whole
        assert len(found) >= before
        before = len(found)
    assert before == len(whole)  # the last cuts take the index only


def _opens(tmp_path: Path, data: bytes) -> bool:
    (tmp_path / "head.mcap").write_bytes(data)
    try:
        open_recording(tmp_path / "head.mcap")
    except FileFormatError as e:
        assert "head.mcap" in str(e)
        return False
    return True


def test_damaged_bytes_give_a_prefix_or_our_error(tmp_path: Path) -> None:
    """A picture that went through is the one recorded: chunks have checksums."""
    path = written(tmp_path / "whole.mcap", count=12)
    data, whole = path.read_bytes(), list(open_recording(path).messages())
    rng = np.random.default_rng(SEED)
    ended_early = 0
    for _ in range(150):
        broken = bytearray(data)
        for at in rng.integers(0, len(data), rng.integers(1, 4)):
            broken[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "broken.mcap").write_bytes(broken)
        try:
            recording = open_recording(tmp_path / "broken.mcap")
        except FileFormatError:
            continue
        found = list(recording.messages())
        ended_early += bool(recording.problem)
        if recording.problem:
            assert [m.data for m in found] == [m.data for m in whole[: len(found)]]
    assert ended_early > 50


def test_a_file_of_somebody_else_is_refused(tmp_path: Path) -> None:
    from mcap.writer import Writer

    other = tmp_path / "other.mcap"
    with other.open("wb") as f:
        writer = Writer(f)
        writer.start()
        writer.finish()  # type: ignore[no-untyped-call]
    (tmp_path / "text.mcap").write_text("hello, this is no recording")
    for name in ("other.mcap", "text.mcap", "absent.mcap"):
        with pytest.raises(FileFormatError, match=name):
            open_recording(tmp_path / name)


# -- the thread


class Blocked:
    """A storage on a disk that hangs until it is let go."""

    retries, due = False, False

    def __init__(self) -> None:
        self.go, self.entered = threading.Event(), threading.Event()
        self.written: list[int] = []

    def write(self, message: Message) -> None:
        self.entered.set()
        assert self.go.wait(30.0)
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
    assert storage.entered.wait(30.0)
    for i in range(1, 200):
        recorder.put(text(0, {}, i), size=QUEUE_BYTES // 100)
    waiting = recorder.counters()
    assert waiting.dropped == 99 and waiting.messages == 0
    storage.go.set()
    assert recorder.stop()
    done = recorder.counters()
    assert storage.written == list(range(101))
    assert done.messages + done.dropped == 200


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
    assert told.acquire(timeout=30.0)
    assert reasons == ["No space left on device (flight.mcap)"]
    recorder.put(text(0, {}, 9))
    stopped = recorder.counters()
    assert stopped.stopped == reasons[0] and stopped.dropped >= 1
    storage.full = False
    now_ns[0] = 31 * S
    _wait(lambda: not recorder.counters().stopped or not retries)
    recorder.put(text(0, {}, 10))
    assert recorder.stop()
    assert storage.written == ([0, 1, 10] if retries else [0, 1])
    assert recorder.counters().messages + recorder.counters().dropped == 7


def _wait(done: Callable[[], bool]) -> None:
    pause = threading.Event()
    for _ in range(3000):
        if done():
            return
        pause.wait(0.01)
    raise AssertionError("it did not come")


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
    assert told.wait(30.0)
    recorder.put(text(0, {}))
    assert recorder.counters().stopped == "ValueError: cannot be encoded"
    assert "cannot be encoded" in caplog.text


def test_a_recording_stops_before_the_disk_is_full(tmp_path: Path) -> None:
    storage = SingleFile(tmp_path / "a.mcap", HEAD, 0, reserve_bytes=10**18)
    storage.tick(S // 2)
    with pytest.raises(OSError, match="not for recordings"):
        storage.tick(2 * S)
    storage.abandon()
    with pytest.raises(FileExistsError):
        SingleFile(tmp_path / "a.mcap", HEAD, 0, reserve_bytes=0)


# -- the ring


class Drive:
    """Feeds a ring ten messages a second and begins new files when it asks, as the estimator does."""

    def __init__(self, folder: Path, boot_id: str = "boot", begins: bool = True, **settings: float) -> None:
        config = RecorderConfig(reserve_bytes=0, **settings)  # type: ignore[arg-type]
        self.ring, self.folder, self.now_ns, self.number = Ring(folder, config, HEAD, boot_id), folder, 0, 0
        self.begins = begins

    def seconds(self, seconds: float) -> Drive:
        for _ in range(round(10 * seconds)):
            self.ring.tick(self.now_ns)
            self.ring.write(picture(self.now_ns, self.number))
            self.now_ns, self.number = self.now_ns + S // 10, self.number + 1
            if self.begins and self.ring.due:
                self.ring.begin(self.now_ns)
        return self

    def killed(self) -> None:
        """Nothing is finished; what the program had not handed over yet is gone."""
        self.ring.abandon()

    def fault(self, reason: str) -> Drive:
        self.ring.fault(reason, self.now_ns)
        return self


def numbers(folder: Path) -> list[int]:
    """Of every message in the files of a folder."""
    return [m.number for f in sorted(folder.glob("*.mcap")) for m in open_recording(f).messages()]


def test_the_ring_keeps_the_last_minutes(tmp_path: Path) -> None:
    drive = Drive(tmp_path, minutes=0.5).seconds(200)
    drive.ring.close()
    kept = numbers(tmp_path / "ring")
    assert kept == list(range(kept[0], 2000))
    assert 300 <= len(kept) <= 400
    assert not list((tmp_path / "kept").iterdir())


def test_the_ring_keeps_to_its_room(tmp_path: Path) -> None:
    limit = 1_000_000
    drive = Drive(tmp_path, minutes=60.0, ring_bytes=limit)
    for _ in range(40):
        drive.seconds(10)
        used = sum(f.stat().st_size for f in (tmp_path / "ring").glob("*.mcap"))
        assert used <= 1.1 * limit  # a second of the newest chunk
    drive.ring.close()
    kept = numbers(tmp_path / "ring")
    assert kept == list(range(kept[0], 4000))
    assert len(kept) * 48 * 64 > 0.5 * limit


def test_a_fault_keeps_what_was_before_and_a_little_after(tmp_path: Path) -> None:
    drive = Drive(tmp_path, minutes=0.5, after_fault_s=5.0).seconds(100).fault("camera gone").seconds(25)
    drive.ring.close()
    (folder,) = (tmp_path / "kept").iterdir()
    assert folder.name.endswith("-camera-gone")
    kept = numbers(folder)
    assert kept == list(range(kept[0], kept[-1] + 1))
    assert kept[0] <= 1000 - 300 and 1040 <= kept[-1] <= 1060
    after = numbers(tmp_path / "ring")
    assert after[0] == kept[-1] + 1


def test_faults_close_together_are_one_and_a_storm_ends(tmp_path: Path) -> None:
    drive = Drive(tmp_path, minutes=0.5, after_fault_s=5.0).seconds(20)
    for _ in range(20):
        drive.fault("base silent").seconds(4)
    drive.ring.close()
    folders = sorted((tmp_path / "kept").iterdir())
    assert [len(numbers(f)) <= 600 for f in folders] == [True] * len(folders)
    assert 2 <= len(folders) <= 4
    everything = [n for f in folders for n in numbers(f)]
    assert everything == list(range(1000))


def test_what_is_kept_has_a_bound_and_the_oldest_go(tmp_path: Path) -> None:
    drive = Drive(tmp_path, minutes=0.5, after_fault_s=1.0, kept_bytes=3_000_000)
    for i in range(10):
        drive.seconds(60).fault(f"number {i}").seconds(5)
    drive.ring.close()
    folders = sorted((tmp_path / "kept").iterdir())
    assert sum(f.stat().st_size for d in folders for f in d.iterdir()) <= 3_000_000
    assert [f.name.rpartition("-")[2] for f in folders] == [str(i) for i in range(10 - len(folders), 10)]
    assert 1 <= len(folders) < 10


def test_a_ring_of_a_process_that_died_is_kept(tmp_path: Path) -> None:
    Drive(tmp_path, minutes=0.5).seconds(20).killed()
    drive = Drive(tmp_path, minutes=0.5).seconds(2)
    drive.ring.close()
    (folder,) = (tmp_path / "kept").iterdir()
    assert folder.name.endswith("-the-process-died")
    assert numbers(folder)[-1] >= 185
    assert numbers(tmp_path / "ring") == list(range(20))


def test_a_ring_of_before_a_power_cut_goes_on(tmp_path: Path) -> None:
    Drive(tmp_path, minutes=0.5).seconds(20).killed()
    Drive(tmp_path, boot_id="another", minutes=0.5).seconds(2).ring.close()
    assert not list((tmp_path / "kept").iterdir())
    names = [f.name for f in sorted((tmp_path / "ring").glob("*.mcap"))]
    assert names == [f"flight-{i:06d}.mcap" for i in range(len(names))]
    assert numbers(tmp_path / "ring")[-20:] == list(range(20))


def test_a_ring_without_anybody_who_knows_where_to_begin_goes_on_all_the_same(tmp_path: Path) -> None:
    """The camera is away: nothing is estimated, but events and health are recorded."""
    drive = Drive(tmp_path, minutes=0.5, after_fault_s=1.0, begins=False).seconds(10).fault("camera gone").seconds(90)
    drive.ring.close()
    (folder,) = (tmp_path / "kept").iterdir()
    assert len(numbers(folder)) <= 200
    assert len(numbers(tmp_path / "ring")) <= 500


def test_a_ring_on_a_full_disk_gives_up_its_past_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = Drive(tmp_path, minutes=0.5).seconds(40)
    drive.ring._cfg = RecorderConfig(minutes=0.5, reserve_bytes=10**9)
    monkeypatch.setattr("ceilvo.drivers.recording.storage.shutil.disk_usage", lambda p: _usage(10**9 - 1))
    drive.now_ns += 2 * S
    with pytest.raises(OSError, match="not for recordings"):
        drive.ring.tick(drive.now_ns)
    drive.ring.abandon()
    assert len(list((tmp_path / "ring").glob("*.mcap"))) == 1
    monkeypatch.setattr("ceilvo.drivers.recording.storage.shutil.disk_usage", lambda p: _usage(10**12))
    drive.ring.tick(drive.now_ns + 2 * S)
    drive.seconds(10).ring.close()
    assert numbers(tmp_path / "ring")[-100:] == list(range(400, 500))


def test_a_ring_whose_disk_goes_away_goes_on_when_it_is_back(tmp_path: Path) -> None:
    """Nothing is made in its place: the mount point would fill the disk below it."""
    state, aside = tmp_path / "state", tmp_path / "aside"
    state.mkdir()
    drive = Drive(state / "recorder", minutes=0.5).seconds(20)
    state.rename(aside)
    drive.now_ns += 2 * S
    for _ in range(2):
        with pytest.raises(FileNotFoundError):
            drive.ring.tick(drive.now_ns)
        drive.ring.abandon()
        assert not state.exists()
    aside.rename(state)
    drive.seconds(10).ring.close()
    assert numbers(state / "recorder" / "ring") == list(range(300))
    assert not list((state / "recorder" / "kept").iterdir()), "no process died"


def test_a_recorder_outlives_a_storage_that_cannot_even_be_closed(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(Failing):
        def abandon(self) -> None:
            raise FileNotFoundError("gone")

    told = threading.Event()
    recorder = Recorder(Broken(), lambda: 0, lambda why: told.set())
    recorder.start()
    for i in range(5):
        recorder.put(text(0, {}, i))
    assert told.wait(30.0)
    assert recorder.stop()
    assert "could not be closed" in caplog.text


def _usage(free: int) -> object:
    from collections import namedtuple

    return namedtuple("Usage", "free")(free)
