"""A recorded drive as other people's programs read it: every message is what its schema says, and it is a 3D scene."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from ceilvo import se2
from ceilvo.config import Base, Config, Filter, Recorder, Service, Zenoh
from ceilvo.daemon.app.process import Daemon, Plan
from ceilvo.drivers.host.systemd_notify import Notifier
from ceilvo.drivers.ports import CameraInfo
from ceilvo.errors import CameraError
from ceilvo.sim.base import SimBase
from ceilvo.sim.camera import SimCamera
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Frame

SEED, FRAMES = 7, 120


class Flickering(SimCamera):
    """Lost after every fortieth frame, so that there are silences, events and unknown quantities."""

    read_so_far = 0

    def read(self) -> Frame | None:
        self.read_so_far += 1
        if self.read_so_far % 40 == 0:
            raise CameraError("camera: unplugged")
        return super().read()

    def open(self) -> CameraInfo:
        return super().open()


@pytest.fixture(scope="module", params=["lossless", "flight"])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with a base that answers, a camera that stumbles, a start again and a pose from outside."""
    folder, world = tmp_path_factory.mktemp("drive"), World(WorldSpec(seed=SEED))
    x, y, theta = (float(v) for v in world.initial_pose)
    start = Filter(initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta)))
    file = folder / "drive.mcap" if request.param == "lossless" else None
    with SimBase(baud=115200) as base:
        config = Config(
            filter=start,
            base=Base(port=base.port, rate_hz=50.0, timeout_s=0.3),
            zenoh=Zenoh(enabled=False, health_period_s=0.1),
            service=Service(state_dir=str(folder)),
            recorder=Recorder(reserve_bytes=0),
        )
        daemon = Daemon(Plan(config, world.calibration, Flickering(world, 30.0), record=file), Notifier({}))
        publish, seen = daemon._outputs.publish, [0]

        def watch(estimate: Any) -> None:
            publish(estimate)
            seen[0] += 1
            if seen[0] == FRAMES // 2:
                daemon._estimator.reset(keep_map=False)
            if seen[0] == 2 * FRAMES // 3:
                daemon._estimator.set_pose(estimate.pose, np.full(3, 0.1), "said by a test")
            if seen[0] >= FRAMES:
                daemon.stop()

        daemon._outputs.publish = watch  # type: ignore[method-assign]
        daemon.run()
    return file or max((folder / "recorder").rglob("*.mcap"), key=lambda f: f.stat().st_size)


def test_every_message_is_what_its_schema_says(recording: Path) -> None:
    """JSON by jsonschema, Protocol Buffers by Google's decoder through the mcap library."""
    seen, validators = Counter[str](), {}
    with recording.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            seen[schema.encoding] += 1
            if schema.encoding == "jsonschema":
                if schema.id not in validators:
                    told = json.loads(schema.data)
                    jsonschema.Draft202012Validator.check_schema(told)
                    validators[schema.id] = jsonschema.Draft202012Validator(told)
                error = jsonschema.exceptions.best_match(validators[schema.id].iter_errors(json.loads(message.data)))
                assert error is None, f"{channel.topic}: {error}"
            else:
                decode = DecoderFactory().decoder_for("protobuf", schema)
                assert decode is not None
                decode(message.data)
    assert seen["jsonschema"] > 2 * FRAMES and seen["protobuf"] > 2 * FRAMES
    print(dict(seen))


def decoded(recording: Path, topic: str) -> list[Any]:
    with recording.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [d.decoded_message for d in reader.iter_decoded_messages(topics=[topic])]


def planar(transform: Any) -> np.ndarray[Any, Any]:
    t, q = transform.translation, transform.rotation
    return np.array([t.x, t.y, 2.0 * np.arctan2(q.z, q.w)])


def test_frames_hang_together_and_lead_to_the_pose(recording: Path) -> None:
    poses = {(m.timestamp.seconds, m.timestamp.nanos): m for m in decoded(recording, "/pose")}
    checked = 0
    parents = {}
    for message in decoded(recording, "/tf"):
        parents |= {t.child_frame_id: t.parent_frame_id for t in message.transforms}
        chain = {t.child_frame_id: planar(t) for t in message.transforms}
        if "odom" not in chain:
            continue
        stamp = message.transforms[0].timestamp
        pose = poses[stamp.seconds, stamp.nanos].pose
        q = pose.orientation
        expected = np.array([pose.position.x, pose.position.y, 2.0 * np.arctan2(q.z, q.w)])
        assert np.abs(se2.between(se2.compose(chain["odom"], chain["base_link"]), expected)).max() < 1e-6
        checked += 1
    assert checked == len(poses) >= FRAMES
    assert parents == {"odom": "map", "base_link": "odom", "camera": "base_link"}


def test_the_scene_has_landmarks_particles_and_the_way(recording: Path) -> None:
    scenes = decoded(recording, "/scene")
    assert scenes
    parts = {e.id: e for scene in scenes for e in scene.entities}
    assert set(parts) == {"landmarks", "particles", "path"}
    assert any(e.spheres for scene in scenes for e in scene.entities if e.id == "landmarks")
    assert parts["particles"].arrows and parts["path"].lines[0].points
    [lens, *_] = decoded(recording, "/camera/calibration")
    assert (lens.width, lens.height, lens.frame_id) == (640, 480, "camera") and len(lens.K) == 9
    assert decoded(recording, "/event")[0].message
