"""ROS 2's messages: golden bytes, and geometry against small hand-made cases."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ros2_parts import UNIX_NS, calibration, estimate, parts, scene

from ceilvo import se2
from ceilvo.calibration import mount_rotation
from ceilvo.drivers.ros2.conversion import UNKNOWN, UNUSABLE, covariance6, distortion_of, quaternion
from ceilvo.types import Estimate, State

GOLDEN = Path(__file__).parents[2] / "golden" / "wire_ros2.json"


def messages() -> dict[str, bytes]:
    """One of every kind, in CDR."""
    p = parts()
    make, e = p.conversion, estimate()
    counters = {"fps": 29.97, "drops": 3, "latency_ms": {"total": {"median": 14.0, "p99": 30.5}}, "other": 1}
    made = {
        "tf": make.tf(make.map_from_odom(e, UNIX_NS), make.odom_from_base(e, UNIX_NS, "base_link")),
        "tf_static": make.tf(make.base_from_camera(UNIX_NS)),
        "pose": make.pose(e, UNIX_NS),
        "odom": make.odometry(e, UNIX_NS, np.diag([1e-3, 2e-3, 3e-3]), np.diag([1e-4, 2e-4, 3e-4])),
        "diagnostics": make.diagnostics(UNIX_NS, State.DEGRADED, e, counters),
        "landmarks": make.landmarks(UNIX_NS, scene().landmarks, np.zeros(2)),
        "particles": make.particles(UNIX_NS, scene().particles),
        "image": make.image(UNIX_NS, b"\xff\xd8jpeg"),
        "camera_info": make.camera_info(UNIX_NS),
    }
    return {name: p.cdr.encode(message) for name, message in made.items()}


@pytest.mark.parametrize("name", list(messages()))
def test_golden_bytes(name: str) -> None:
    """The bytes of a wire must not change by accident; running this file writes them anew."""
    golden = json.loads(GOLDEN.read_text())
    assert messages()[name].hex() == golden[name]


def test_a_pose_byte_by_byte() -> None:
    """By hand from the CDR rules: header, stamp, string with its length and zero, padding to 8, doubles."""
    data = messages()["pose"]
    assert data[:4].hex() == "00010000"
    assert int.from_bytes(data[4:8], "little") == 1_750_000_000
    assert int.from_bytes(data[8:12], "little") == 123_456_789
    assert data[12:16].hex() == "04000000" and data[16:20] == b"map\0"
    numbers = np.frombuffer(data[20:], "<f8")
    assert np.allclose(numbers[:3], [1.25, -0.5, 0.0])
    assert np.allclose(numbers[3:7], [0.0, 0.0, np.sin(0.375), np.cos(0.375)])
    assert len(numbers) == 7 + 36


def chain(p: Any, e: Estimate) -> np.ndarray[Any, Any]:
    """map_from_base that a reader of /tf composes from both transforms."""
    message = p.cdr.decode(
        p.cdr.encode(p.conversion.tf(p.conversion.map_from_odom(e, 0), p.conversion.odom_from_base(e, 0, "base_link"))),
        "tf2_msgs/msg/TFMessage",
    )
    planar = []
    for t, (parent, child) in zip(message.transforms, (("map", "odom"), ("odom", "base_link")), strict=True):
        assert (t.header.frame_id, t.child_frame_id) == (parent, child)
        q, v = t.transform.rotation, t.transform.translation
        planar.append(np.array([v.x, v.y, 2.0 * np.arctan2(q.z, q.w)]))
    return se2.compose(*planar)


def test_the_chain_of_transforms_is_the_pose() -> None:
    p, rng = parts(), np.random.default_rng(3)
    for _ in range(200):
        pose, odom = (np.append(rng.uniform(-1e3, 1e3, 2), rng.uniform(-np.pi, np.pi)) for _ in range(2))
        found = chain(p, estimate(pose=pose, odom=odom))
        assert np.abs(se2.between(found, pose)).max() < 1e-6


def test_map_to_odom_is_dated_ahead_and_odometry_is_not() -> None:
    p = parts(transform_tolerance_s=0.25)
    stamps = [
        t.header.stamp.sec * 10**9 + t.header.stamp.nanosec
        for t in (
            p.conversion.map_from_odom(estimate(), UNIX_NS),
            p.conversion.odom_from_base(estimate(), UNIX_NS, "b"),
        )
    ]
    assert stamps == [UNIX_NS + 250_000_000, UNIX_NS]


def test_covariances_know_what_they_do_not_know() -> None:
    cov = np.arange(9.0).reshape(3, 3) + np.diag([1.0, 0.0, 0.0])
    six = covariance6(cov).reshape(6, 6)
    assert np.array_equal(six[np.ix_([0, 1, 5], [0, 1, 5])], cov)
    assert [six[i, i] for i in (2, 3, 4)] == [UNKNOWN] * 3
    used = {0, 1, 5, 6, 7, 11, 30, 31, 35, 14, 21, 28}
    assert all(v == 0.0 for i, v in enumerate(six.ravel()) if i not in used)
    assert np.diag(covariance6(np.full((3, 3), np.nan)).reshape(6, 6)).tolist() == [UNKNOWN] * 6
    assert np.all(np.diag(covariance6(np.zeros((3, 3))).reshape(6, 6)) > 0.0)


@pytest.mark.parametrize("state", UNUSABLE)
def test_a_pose_that_must_not_be_used_has_no_known_variance(state: State) -> None:
    message = parts().conversion.pose(estimate(state=state), UNIX_NS)
    assert [message.pose.covariance[i] for i in (0, 7, 35)] == [UNKNOWN] * 3


def test_quaternions_turn_as_their_matrices() -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        r = mount_rotation(*rng.uniform(-1.5, 1.5, 3))
        x, y, z, w = quaternion(r)
        back = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        assert np.abs(back - r).max() < 1e-12 and w >= 0.0


def test_the_camera_sits_where_it_was_calibrated() -> None:
    """Mounted at (0.25, -0.1) and turned by a quarter."""
    t = parts().conversion.base_from_camera(0).transform
    assert np.allclose([t.translation.x, t.translation.y, t.translation.z], [0.25, -0.1, 0.0])
    q = t.rotation
    assert np.allclose(np.abs([q.x, q.y, q.z, q.w]), [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    expected = calibration().camera_from_base.T @ np.array([1.0, 0.0, 0.0])
    assert np.allclose([1 - 2 * q.z * q.z, 2 * q.z * q.w], expected[:2])


def test_lens_models() -> None:
    assert distortion_of("pinhole", ()) == ("plumb_bob", (0.0,) * 5)
    assert distortion_of("pinhole", (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)) == (
        "rational_polynomial",
        (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.0, 0.0),
    )
    assert distortion_of("fisheye", (1.0, 2.0)) == ("equidistant", (1.0, 2.0, 0.0, 0.0))


def test_no_message_has_a_nan() -> None:
    p = parts()
    assert len(p.conversion.particles(0, scene().particles).poses) == 1, "one of the two is not finite"
    odd = estimate(cov=np.full((3, 3), np.inf))
    assert np.isfinite(p.conversion.pose(odd, 0).pose.covariance).all()


@pytest.mark.parametrize(("floor", "told"), [("first", ["first"]), ("", [])])
def test_diagnostics_name_the_floor_where_there_are_several(floor: str, told: list[str]) -> None:
    p = parts()
    data = p.cdr.encode(p.conversion.diagnostics(UNIX_NS, State.TRACKING, replace(estimate(), floor=floor), {}))
    status = p.cdr.decode(data, "diagnostic_msgs/msg/DiagnosticArray").status[0]
    assert [v.value for v in status.values if v.key == "map_id"] == told


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps({name: data.hex() for name, data in messages().items()}, indent=1) + "\n")
