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
from recorded_drive import FRAMES, record_drive

from ceilvo import se2


@pytest.fixture(scope="module", params=["lossless", "flight"])
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_drive(tmp_path_factory.mktemp("drive"), request.param == "lossless")


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
