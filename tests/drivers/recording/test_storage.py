"""The ring and what it keeps of faults, kills and full disks; a single file stops before the disk is full."""

from __future__ import annotations

from pathlib import Path

import pytest
from recording_messages import HEAD, S, picture

from ceilvo.config import Recorder as RecorderConfig
from ceilvo.drivers.recording.mcap_reader import open_recording
from ceilvo.drivers.recording.storage import Ring, SingleFile


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


def _usage(free: int) -> object:
    from collections import namedtuple

    return namedtuple("Usage", "free")(free)
