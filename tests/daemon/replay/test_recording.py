"""A run that is recorded, and the same run again from its recording: equal to the last bit."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from ceilvo.calibration_file import parse_calibration, render_calibration
from ceilvo.config import Base, Config, Filter, Service, Zenoh
from ceilvo.config import Recorder as RecorderConfig
from ceilvo.config.reader import parse_config
from ceilvo.config.rendering import render_config
from ceilvo.daemon import cli
from ceilvo.daemon.app.process import Daemon, Plan
from ceilvo.daemon.replay.recording import faults_in
from ceilvo.daemon.replay.trajectory import estimate_json, tum_line
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.ports import CameraInfo
from ceilvo.drivers.recording.mcap_reader import Recorded, open_recording
from ceilvo.errors import CameraError, FileFormatError
from ceilvo.sim.base import SimBase
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Estimate, Frame

SEED = 7


@pytest.fixture(scope="module")
def world() -> World:
    """For cameras that draw as fast as they are asked; one in real time has its own, which its thread may outlive."""
    return World(WorldSpec(seed=SEED))


@pytest.fixture
def base() -> Iterator[SimBase]:
    with SimBase(baud=115200) as simulated:
        yield simulated


def config_of(world: World, port: str = "", state_dir: str = "", **recorder: object) -> Config:
    x, y, theta = (float(v) for v in world.initial_pose)
    return Config(
        filter=Filter(initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))),
        base=Base(enabled=bool(port), port=port or "/dev/null", rate_hz=50.0, timeout_s=0.3),
        zenoh=Zenoh(enabled=False),
        service=Service(state_dir=state_dir),
        recorder=RecorderConfig(reserve_bytes=0, **recorder),  # type: ignore[arg-type]
    )


class Watched(Daemon):
    """Remembers what it published, and calls somebody after each estimate."""

    def __init__(self, plan: Plan, after: Callable[[Watched, int], None] = lambda daemon, count: None) -> None:
        super().__init__(plan, Notifier({}))
        self.said: list[Estimate] = []
        self._after = after
        publish = self._outputs.publish

        def watch(estimate: Estimate) -> None:
            self.said.append(estimate)
            publish(estimate)
            self._after(self, len(self.said))

        self._outputs.publish = watch  # type: ignore[method-assign]


class Stumbling(SimCamera):
    """Lost after thirty frames, until `back` is set."""

    def __init__(self, world: World, rate_hz: float) -> None:
        super().__init__(world, rate_hz)
        self.left, self.back = 30, threading.Event()

    def read(self) -> Frame | None:
        self.left -= 1
        if self.left == 0:
            raise CameraError("camera: unplugged")
        return super().read()

    def open(self) -> CameraInfo:
        if self.left <= 0 and not self.back.is_set():
            raise CameraError("camera: unplugged")
        return super().open()


def busy(daemon: Watched, count: int) -> None:
    """Everything that can be done to an estimator from outside, on the way."""
    camera = daemon._plan.camera
    if "unplugged" in (daemon.said[-1].motion.failure or "") and isinstance(camera, Stumbling):
        camera.back.set()
    if count == 45:
        daemon._estimator.set_pose(np.array([1.0, 1.2, 0.1]), np.array([0.1, 0.1, 0.05]), "said by a test")
    if count == 60:
        daemon._estimator.reset(keep_map=True)
    if count == 70:
        daemon._estimator.relocalise()
    if count == 80:
        daemon._estimator.reset(keep_map=False)
    if count >= 110:
        daemon.stop()


def test_a_replay_gives_the_same_bytes(world: World, base: SimBase, tmp_path: Path) -> None:
    """Wheels from a real line, silences at random times, commands: all of it comes from the recording alone."""
    file = tmp_path / "run.mcap"
    config = config_of(world, base.port)
    daemon = Watched(Plan(config, world.calibration, Stumbling(World(WorldSpec(seed=SEED)), 30.0), record=file), busy)
    summary = daemon.run()
    assert summary["recorder"]["dropped"] == 0 and summary["recorder"]["stopped"] == ""
    reasons = [e.motion.failure or "" for e in daemon.said]
    assert any("unplugged" in r for r in reasons), "a silence is part of the test"
    jsonl, tum = tmp_path / "again.jsonl", tmp_path / "again.tum"
    assert cli.main(["replay", str(file), "--jsonl", str(jsonl), "--tum", str(tum)]) == 0
    assert jsonl.read_text() == "".join(estimate_json(e) for e in daemon.said)
    assert tum.read_text() == "".join(tum_line(e.stamp_ns, e.pose) for e in daemon.said)
    kinds = {json.loads(m.data)["input"] for m in topic(file, "/input")}
    assert kinds == {"frame", "silence", "assumption", "reset"}
    assert any(json.loads(m.data).get("wheels") for m in topic(file, "/input"))


def topic(file: Path, name: str) -> list[Recorded]:
    return [m for m in open_recording(file).messages() if m.topic == name]


def drive(world: World, file: Path, seconds: float = 1.5, state_dir: str = "", port: str = "") -> Watched:
    """A run that ends by itself, recorded; frames as fast as they are estimated."""
    camera = SimCamera(world, 20.0, realtime=False, duration_s=seconds)
    daemon = Watched(Plan(config_of(world, port, state_dir), world.calibration, camera, record=file))
    daemon.run()
    return daemon


def test_a_stored_map_is_part_of_the_recording(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("first", "second"):
        said = drive(world, tmp_path / f"{name}.mcap", state_dir=str(tmp_path)).said
    (tmp_path / "map.db").unlink()
    assert cli.main(["replay", str(tmp_path / "second.mcap"), "--jsonl", str(tmp_path / "again.jsonl")]) == 0
    assert (tmp_path / "again.jsonl").read_text() == "".join(estimate_json(e) for e in said)
    assert json.loads(topic(tmp_path / "second.mcap", "/input")[0].data)["input"] == "known_map"
    assert "30 of 30 estimates are the same to the last bit" in capsys.readouterr().out


def test_a_recording_says_everything_that_happened(world: World, base: SimBase, tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    stop = lambda daemon, count: daemon.stop() if count >= 40 else None  # noqa: E731
    camera = SimCamera(World(WorldSpec(seed=SEED)), 20.0)
    daemon = Watched(Plan(config_of(world, base.port), world.calibration, camera, record=file), stop)
    daemon.run()
    messages = list(open_recording(file).messages())
    count = {t: sum(m.topic == t for m in messages) for t in {m.topic for m in messages}}
    assert count["/camera"] == count["/pose"] == count["/estimate"] == count["/latency"] == len(daemon.said)
    assert count["/health"] >= 2 and count["/event"] >= 2
    sent = [json.loads(m.data) for m in topic(file, "/telegram")]
    received = [r.telegram for r in base.telegrams]
    heard, answered = {t.heartbeat for t in received}, {t["heartbeat"] for t in sent if t["answered"]}
    assert answered <= heard <= {t["heartbeat"] for t in sent}  # a busy machine may miss an answer
    assert sent[-1]["state"] == "STOPPED"
    assert count["/base_status"] == len(answered) > 0
    stamps = [m.log_ns for m in messages if m.topic == "/estimate"]
    assert stamps == sorted(stamps) and abs(stamps[0] / 1e9 - file.stat().st_ctime) < 3600
    recording = open_recording(file)
    assert parse_config(recording.text("config.yaml"), "x") == daemon._config
    assert recording.metadata["frames"] == "lossless" and recording.metadata["robot"] == "robot1"


def test_a_cut_recording_replays_up_to_the_cut(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "run.mcap"
    said = drive(world, file).said
    data = file.read_bytes()
    for share in (0.5, 0.8):
        (tmp_path / "cut.mcap").write_bytes(data[: int(share * len(data))])
        assert cli.main(["replay", str(tmp_path / "cut.mcap"), "--jsonl", str(tmp_path / "cut.jsonl")]) == 0
        again = (tmp_path / "cut.jsonl").read_text().splitlines(keepends=True)
        assert 0 < len(again) < len(said)
        assert again == [estimate_json(e) for e in said[: len(again)]]
        out = capsys.readouterr().out
        assert "ends in the middle (power cut, killed, or still being written); all up to there was read" in out
        assert f"{len(again)} of {len(again)} estimates are the same" in out


def test_another_configuration_is_not_compared(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "run.mcap"
    drive(world, file, 0.5)
    assert cli.main(["replay", str(file), "--set", "filter.particles=20"]) == 0
    assert "not compared: another configuration" in capsys.readouterr().out


def test_a_difference_is_told_and_is_a_failure(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "run.mcap"
    drive(world, file, 0.5)
    monkeypatch.setattr("ceilvo.daemon.pipeline.START_SIGMA", np.array([1e-3, 1e-3, 1.1e-3]))
    assert cli.main(["replay", str(file)]) == 1
    assert "the first other one is" in capsys.readouterr().out


def test_a_file_is_not_overwritten(world: World, tmp_path: Path) -> None:
    file = tmp_path / "run.mcap"
    file.write_text("something of mine")
    with pytest.raises(FileFormatError, match="File exists"):
        drive(world, file)
    assert file.read_text() == "something of mine"


# -- the flight recorder in the daemon


def test_a_lost_camera_keeps_the_last_minutes(world: World, base: SimBase, tmp_path: Path) -> None:
    config = config_of(world, base.port, str(tmp_path), minutes=0.2, after_fault_s=0.5, jpeg_rate_hz=10.0)
    config = replace(config, zenoh=replace(config.zenoh, health_period_s=0.1))

    def until_kept(daemon: Watched, count: int) -> None:
        if any((tmp_path / "recorder" / "kept").glob("*/*.mcap")):
            daemon.stop()

    camera = Stumbling(World(WorldSpec(seed=SEED)), 30.0)
    camera.left = 90  # a busy computer takes one frame in several
    daemon = Watched(Plan(config, world.calibration, camera), until_kept)
    summary = daemon.run()
    assert summary["recorder"]["faults"] >= 1
    (folder,) = (tmp_path / "recorder" / "kept").iterdir()
    assert folder.name == "000000-camera-gone"
    files = sorted(folder.glob("*.mcap"))
    assert open_recording(files[0]).metadata["start"] == "fresh"
    pictures = [m for f in files for m in topic(f, "/camera/jpeg")]
    estimates = [m for f in files for m in topic(f, "/estimate")]
    assert len(estimates) > len(pictures) >= 3
    events = [Log.FromString(m.data).message for f in files for m in topic(f, "/event")]
    assert any("unplugged" in e for e in events)


def fly(world: World, folder: Path, seconds: float, **recorder: object) -> Watched:
    camera = SimCamera(world, 20.0, realtime=False, duration_s=seconds)
    daemon = Watched(Plan(config_of(world, state_dir=str(folder), **recorder), world.calibration, camera))
    daemon.run()
    return daemon


def test_the_ring_replays_from_any_of_its_files(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Default settings but for shorter files: no file has the pixels, and all but the first begin in the middle."""
    # a file ends when it is full, however fast this computer is
    monkeypatch.setattr("ceilvo.drivers.recording.storage._SEGMENTS", 200)
    monkeypatch.setattr("ceilvo.drivers.recording.storage._MIN_SEGMENT_S", 0.0)
    daemon = fly(world, tmp_path, 4.0, ring_bytes=20_000_000, minutes=60.0)
    ring = tmp_path / "recorder" / "ring"
    files = sorted(ring.glob("*.mcap"))
    assert len(files) >= 2
    assert open_recording(files[-1]).metadata["start"] == "joined"
    counts = []
    for source in (ring, *files[1:]):
        assert cli.main(["replay", str(source), "--jsonl", str(tmp_path / "again.jsonl")]) == 0
        again = (tmp_path / "again.jsonl").read_text()
        assert again in "".join(estimate_json(e) for e in daemon.said)
        inside = [m for f in (files if source == ring else [source]) for m in topic(f, "/estimate")]
        count = len(again.splitlines())
        assert count == len(inside)
        counts.append(count)
        assert f"{count} of {count} estimates are the same to the last bit" in capsys.readouterr().out
    assert counts[0] == len(daemon.said) and sum(counts[1:]) > 0


def test_pictures_alone_are_no_exact_replay(world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fly(world, tmp_path, 2.0, features=False, jpeg_rate_hz=10.0)
    (file,) = (tmp_path / "recorder" / "ring").glob("*.mcap")
    assert cli.main(["replay", str(file)]) == 0
    out = capsys.readouterr().out
    assert out.startswith(("frames     20", "frames     21"))
    assert "not compared: it has JPEG pictures" in out


def test_two_runs_in_a_folder_are_replayed_each_by_itself(
    world: World, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ring, results = tmp_path / "recorder" / "ring", {}
    said = [fly(world, tmp_path, 0.5).said, fly(world, tmp_path, 0.5).said]
    for jobs in ("1", "2"):
        words = ["--jsonl", str(tmp_path / f"{jobs}.jsonl"), "--jobs", jobs]
        assert cli.main(["replay", str(ring), *words]) == 0
        results[jobs] = [p.read_text() for p in sorted(tmp_path.glob(f"{jobs}-*.jsonl"))]
        assert capsys.readouterr().out.count("are the same to the last bit") == 2
    assert results["1"] == results["2"] == ["".join(map(estimate_json, run)) for run in said]


def test_without_a_state_directory_nothing_is_recorded(world: World, tmp_path: Path) -> None:
    camera = SimCamera(world, 20.0, realtime=False, duration_s=0.5)
    summary = Watched(Plan(config_of(world), world.calibration, camera)).run()
    assert "recorder" not in summary


def test_a_full_disk_is_told_and_localisation_goes_on(world: World, tmp_path: Path) -> None:
    camera = SimCamera(world, 20.0, realtime=False, duration_s=2.0)
    config = config_of(world, state_dir=str(tmp_path))
    config = replace(config, recorder=replace(config.recorder, reserve_bytes=10**12))
    daemon = Watched(Plan(config, world.calibration, camera))
    summary = daemon.run()
    assert summary["frames"] == 40
    assert "not for recordings" in summary["recorder"]["stopped"]
    assert sum("recording stopped" in e and "localisation goes on" in e for e in daemon.events) == 1


@pytest.mark.parametrize(
    ("counters", "faults"),
    [
        ({}, set()),
        ({"camera_connected": False, "camera_losses": 0}, set()),  # it has not come yet
        ({"camera_connected": False, "camera_losses": 1}, {"camera gone"}),
        ({"camera_connected": True, "camera_losses": 3}, set()),
        ({"base_link_age_s": None}, set()),
        ({"base_link_age_s": 0.1}, set()),
        ({"base_link_age_s": 1.5, "calibration_stale": True}, {"base silent", "calibration stale"}),
    ],
)
def test_faults_are_found_in_the_counters(counters: dict[str, object], faults: set[str]) -> None:
    assert faults_in(counters) == faults


def test_configuration_and_calibration_come_back_from_their_texts(world: World) -> None:
    config = config_of(world, "/dev/ttyUSB7")
    assert parse_config(render_config(config), "x") == config
    again = parse_calibration(render_calibration(world.calibration, "x"), "x")
    assert again.projection.tobytes() == np.asarray(world.calibration.projection).tobytes()
    assert again.camera == world.calibration.camera
