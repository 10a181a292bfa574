"""A recording as a ROS 2 bag, read by rosbags and by mcap: it says what the recording's JSON says."""

from __future__ import annotations

import contextlib
import copy
import json
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from recorded_drive import FRAMES, record_drive
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from rosbags.typesys import Stores, get_typestore

from ceilvo import se2
from ceilvo.daemon import cli
from ceilvo.daemon.app.readers.export import export_ros2
from ceilvo.daemon.replay.trajectory import estimate_json, read_estimate
from ceilvo.drivers.pictures import decoded
from ceilvo.drivers.recording import foxglove
from ceilvo.drivers.recording.mcap_reader import open_recording
from ceilvo.errors import FileFormatError

SEED = 16
TYPES = {
    "/amcl_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/odom": "nav_msgs/msg/Odometry",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/landmarks": "visualization_msgs/msg/MarkerArray",
    "/particles": "geometry_msgs/msg/PoseArray",
    "/image/compressed": "sensor_msgs/msg/CompressedImage",
    "/camera_info": "sensor_msgs/msg/CameraInfo",
}


@pytest.fixture(scope="module", params=["lossless", "flight"])
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A recording and its bag."""
    folder = tmp_path_factory.mktemp("drive")
    recording, bag = record_drive(folder, request.param == "lossless"), folder / "ros.mcap"
    assert export_ros2(recording, bag, ("ros2.pose_topic=amcl_pose",)) == 0
    assert [p.name for p in folder.glob(".ros*")] == []
    return recording, bag


def told(recording: Path, topic: str) -> list[tuple[int, bytes]]:
    """Messages with their times, in the order of these, as readers of bags give them."""
    found = [(m.log_ns, m.data) for m in open_recording(recording).messages() if m.topic == topic]
    return sorted(found, key=lambda one: one[0])


def by_rosbags(bag: Path, topic: str) -> list[tuple[int, Any]]:
    with AnyReader([bag]) as reader:
        connections = [c for c in reader.connections if c.topic == topic]
        return [(at, reader.deserialize(data, c.msgtype)) for c, at, data in reader.messages(connections)]


def stamp_ns(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def planar(at: Any, q: Any) -> np.ndarray[Any, Any]:
    return np.array([at.x, at.y, 2.0 * np.arctan2(q.z, q.w)])


def test_types_and_definitions(exported: tuple[Path, Path]) -> None:
    """The definitions come from the file alone, and give the hashes that ROS 2 has."""
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([exported[1]]) as reader:
        assert {c.topic: c.msgtype for c in reader.connections} == TYPES
        for c in reader.connections:
            assert reader.typestore.hash_rihs01(c.msgtype) == jazzy.hash_rihs01(c.msgtype), c.topic
            [qos] = c.ext.offered_qos_profiles  # type: ignore[union-attr]
            assert (qos.durability is QosDurability.TRANSIENT_LOCAL) is (c.topic in ("/amcl_pose", "/tf_static"))


def test_poses_and_transforms_are_those_of_the_json(exported: tuple[Path, Path]) -> None:
    recording, bag = exported
    lines = [(at, json.loads(data)) for at, data in told(recording, "/estimate")]
    poses, odometry = by_rosbags(bag, "/amcl_pose"), by_rosbags(bag, "/odom")
    assert [at for at, _ in poses] == [at for at, _ in odometry] == [at for at, _ in lines]
    assert len(poses) >= FRAMES
    for (at, m), (_, line) in zip(poses, lines, strict=True):
        assert stamp_ns(m.header) == at and m.header.frame_id == "map"
        found = planar(m.pose.pose.position, m.pose.pose.orientation)
        assert np.abs(se2.between(found, np.array(line["pose_map_from_base"]))).max() < 1e-12
    for (_, m), (_, line) in zip(odometry, lines, strict=True):
        found = planar(m.pose.pose.position, m.pose.pose.orientation)
        assert np.abs(se2.between(found, np.array(line["pose_odom_from_base"]))).max() < 1e-12
    chains = 0
    for (at, m), (_, line) in zip(by_rosbags(bag, "/tf"), lines, strict=True):
        link = {
            t.child_frame_id: (t.header, planar(t.transform.translation, t.transform.rotation)) for t in m.transforms
        }
        assert stamp_ns(link["base_link"][0]) == at and link["base_link"][0].frame_id == "odom"
        usable = line["state"] in ("TRACKING", "DEGRADED", "DEAD_RECKONING")
        assert ("odom" in link) is usable
        if usable:
            assert link["odom"][0].frame_id == "map" and stamp_ns(link["odom"][0]) == at + 100_000_000
            whole = se2.compose(link["odom"][1], link["base_link"][1])
            assert np.abs(se2.between(whole, np.array(line["pose_map_from_base"]))).max() < 1e-6
            chains += 1
    assert chains > 0
    [(_, static)] = by_rosbags(bag, "/tf_static")
    assert [(t.header.frame_id, t.child_frame_id) for t in static.transforms] == [
        ("base_link", "ceiling_camera_optical_frame")
    ]


def test_pictures_scene_and_health(exported: tuple[Path, Path]) -> None:
    recording, bag = exported
    raw, jpeg = (dict(told(recording, topic)) for topic in ("/camera", "/camera/jpeg"))
    pictures = by_rosbags(bag, "/image/compressed")
    assert [at for at, _ in pictures] == list(raw or jpeg) and pictures
    for at, m in pictures[:5]:
        if raw:
            shown = decoded(bytes(m.data))
            assert m.format == "png" and np.array_equal(shown, foxglove.read_raw_image(raw[at]))  # type: ignore[arg-type]
        else:
            assert (bytes(m.data), m.format) == foxglove.compressed_bytes(jpeg[at])
    lenses = by_rosbags(bag, "/camera_info")
    assert len(lenses) == len(pictures) and (lenses[0][1].width, lenses[0][1].height) == (640, 480)
    states = [json.loads(data)["state"] for _, data in told(recording, "/health")]
    told_states = [{v.key: v.value for v in m.status[0].values}["state"] for _, m in by_rosbags(bag, "/diagnostics")]
    assert told_states == states and states
    scenes = [foxglove.read_scene(data) for _, data in told(recording, "/scene")]
    marked, spread = by_rosbags(bag, "/landmarks"), by_rosbags(bag, "/particles")
    assert len(marked) == len(spread) == len(scenes)
    for (_, m), (_, p), (xy, particles) in zip(marked, spread, scenes, strict=True):
        assert np.array_equal(np.array([(q.x, q.y) for q in m.markers[0].points]).reshape(-1, 2), xy)
        assert np.allclose(np.array([planar(q.position, q.orientation) for q in p.poses]).reshape(-1, 3), particles)
    assert any(len(xy) for xy, _ in scenes)


def test_mcap_reads_the_same_bytes(exported: tuple[Path, Path]) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    by_mcap: list[tuple[int, Any]] = []
    with exported[1].open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        for schema, channel, message in reader.iter_messages():
            assert schema is not None and (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            assert schema.name == TYPES[channel.topic]
            if channel.topic == "/amcl_pose":
                pose = store.deserialize_cdr(message.data, schema.name).pose.pose  # type: ignore[attr-defined]
                by_mcap.append((message.log_time, planar(pose.position, pose.orientation)))
    expected = [
        (at, planar(m.pose.pose.position, m.pose.pose.orientation)) for at, m in by_rosbags(exported[1], "/amcl_pose")
    ]
    assert [at for at, _ in by_mcap] == [at for at, _ in expected] and len(by_mcap) >= FRAMES
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(by_mcap, expected, strict=True))


def test_estimates_read_back(exported: tuple[Path, Path]) -> None:
    lines = [data for _, data in told(exported[0], "/estimate")]
    assert len(lines) >= FRAMES
    for line in lines:
        assert estimate_json(read_estimate(line)).encode() == line


@pytest.mark.parametrize("line", [b"", b"[]", b"{}", b'{"motion": {}, "depletion": {}}', b"\xff", b"[" * 100_000])
def test_what_is_no_estimate(line: bytes) -> None:
    with pytest.raises(FileFormatError, match="the recording is damaged"):
        read_estimate(line)


def test_changed_estimates_are_refused_or_read(exported: tuple[Path, Path]) -> None:
    """Any value of any key in the place of any other: our error or an estimate, nothing else."""
    line = json.loads(told(exported[0], "/estimate")[0][1])
    rng, odd = random.Random(SEED), (None, "", "LOST", -1, 1e300, True, [], {}, [1.0, 2.0], [[0.0] * 3] * 3, [None] * 3)
    read = 0
    for _ in range(2000):
        changed = copy.deepcopy(line)
        owner = rng.choice([changed, changed, changed["motion"], changed["depletion"]])
        name = rng.choice(sorted(owner))
        if rng.random() < 0.2:
            del owner[name]
        else:
            owner[name] = rng.choice(odd)
        with contextlib.suppress(FileFormatError):
            assert read_estimate(json.dumps(changed).encode()).pose.shape == (3,)
            read += 1
    assert 200 < read < 1900, f"seed {SEED}: both happen"


def test_refusals(exported: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording, bag = exported
    before = bag.read_bytes()
    for out, why in (
        (bag, "is there already, expected a new name"),
        (tmp_path / "drive.bag", "ends in '.bag', expected a name that ends in .mcap"),
        (tmp_path / "no" / "drive.mcap", "cannot be written: No such file or directory"),
    ):
        assert cli.main(["export", str(recording), str(out), "--ros2"]) == 1
        assert f"ceilvod: {out}: {why}" in capsys.readouterr().err
    assert bag.read_bytes() == before
    assert list(tmp_path.iterdir()) == []
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recording.read_bytes()[: recording.stat().st_size // 2])
    assert cli.main(["export", str(cut), str(tmp_path / "half.mcap"), "--ros2"]) == 0
    assert "it ends in the middle" in capsys.readouterr().out
    assert by_rosbags(tmp_path / "half.mcap", "/odom")
