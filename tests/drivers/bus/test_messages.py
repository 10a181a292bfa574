"""The JSON on the bus: golden bytes of every message, and parsers against everything that a stranger may send."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.config import Config
from ceilvo.drivers.bus import commands, messages
from ceilvo.drivers.bus.commands import MAX_COMMAND_BYTES, InitialPose, Relocalise, Reset, SaveMap, parse_command
from ceilvo.errors import BusError
from ceilvo.types import Estimate, FilterHealth, Landmarks, Motion, State

GOLDEN = Path(__file__).parents[2] / "golden"
DOCS = Path(__file__).parents[3] / "docs" / "zenoh.md"
STAMP = messages.Stamp(ns=5_000_000_000, unix_ns=1_750_000_000_000_000_000)


def estimate() -> Estimate:
    motion = Motion(np.array([0.02, -0.001, 0.005]), np.diag([1e-6, 1e-6, 4e-8]), inliers=24, rms_m=0.0012)
    return Estimate(
        seq=42,
        stamp_ns=4_980_000_000,
        pose=np.array([1.25, -0.5, 0.75]),
        cov=np.array([[4e-4, 1e-5, 0.0], [1e-5, 9e-4, 2e-6], [0.0, 2e-6, 2.5e-5]]),
        odom=np.array([1.5, -0.25, 0.5]),
        twist=np.array([0.6, -0.03, 0.15]),
        state=State.TRACKING,
        quality=0.97,
        reason="",
        motion=motion,
        health=FilterHealth(100, 71.5, 12, math.nan, 1.1, 18),
        crossings=31,
        landmarks=57,
        latency_ms={"capture": 3.5, "features": 6.25, "total": 14.0},
    )


def landmarks() -> Landmarks:
    cov = np.array([[[1e-4, 2e-5], [2e-5, 3e-4]], [[4e-4, 0.0], [0.0, 4e-4]]])
    return Landmarks(np.array([3, 8]), np.array([[0.6, 1.2], [1.8, -0.6]]), cov, np.array([4, 2]), np.array([12, 5]))


def calibration() -> Calibration:
    camera = CameraModel("pinhole", 640, 480, 400.0, 400.0, 320.0, 240.0, (-0.25, 0.05, 0.0, 0.0, 0.0))
    m = projection_matrix(camera, mount_rotation(0.0), (0.25, 0.0), 2.0)
    noise = NoiseCurves((0.004, 0.001), (0.005, 0.002), 0.002, 0.2, 1.5)
    return Calibration(camera, m, noise, camera_id="usb-1", created="2025-06-15", tile_m=0.6, meta={"rms_px": 0.3})


def samples() -> dict[str, bytes]:
    particles = np.array([[1.0, 2.0, 0.5], [1.5, 2.5, -0.5]])
    return {
        "pose": messages.encode_pose("robot1", estimate(), STAMP.unix_ns, 5_000_000_000, "first", 7),
        "odom": messages.encode_odom("robot1", estimate(), STAMP.unix_ns),
        "health": messages.encode_health(
            "robot1", STAMP, 12.5, State.TRACKING, {"frames": 360, "drops": 1, "fps": 29.5}
        ),
        "event": messages.encode_event(
            "robot1", STAMP, "state", "warning", "TRACKING -> DEGRADED: 4 inliers", {"from": "TRACKING", "inliers": 4}
        ),
        "landmarks": messages.encode_landmarks("robot1", STAMP, landmarks()),
        "particles": messages.encode_particles("robot1", 42, STAMP, particles, np.array([0.25, 0.75])),
        "map": messages.encode_map("robot1", STAMP, landmarks()),
        "calibration": messages.encode_calibration("robot1", calibration()),
        "reply": messages.encode_reply(
            "robot1", "save_map", {"did": "saved", "folder": "/var/lib/ceilvo", "landmarks": 57}
        ),
        "error": messages.encode_error("robot1", "reset", "command reset: keep_map is 1, expected true or false"),
    }


@pytest.mark.parametrize("name", samples())
def test_golden_bytes(name: str) -> None:
    assert samples()[name] + b"\n" == (GOLDEN / f"wire_{name}.json").read_bytes()


@pytest.mark.parametrize("name", samples())
def test_docs_show_the_golden_message(name: str) -> None:
    blocks = [json.loads(b.split("```")[0]) for b in DOCS.read_text().split("```json\n")[1:]]
    assert json.loads(samples()[name]) in blocks


@pytest.mark.parametrize("name", samples())
def test_every_message_is_one_line_of_strict_json_with_schema_and_robot(name: str) -> None:
    def refuse(text: str) -> Any:
        raise AssertionError(f"{text} is not JSON")

    raw = samples()[name]
    fields = json.loads(raw, parse_constant=refuse)
    assert b"\n" not in raw
    assert raw.isascii()
    assert fields["schema"] == f"ceilvo.{'reply' if name == 'error' else name}.1"
    assert fields["robot"] == "robot1"


def test_pose_numbers_by_hand() -> None:
    f = json.loads(samples()["pose"])
    assert (f["sigma_x_m"], f["sigma_y_m"]) == pytest.approx((0.02, 0.03))
    assert f["sigma_theta_rad"] == pytest.approx(0.005)
    assert f["age_ms"] == 20.0
    assert f["fit_residual"] is None  # nan in the estimate


def test_pose_round_trip_is_exact() -> None:
    e = estimate()
    p = messages.decode_pose(samples()["pose"])
    assert (p.robot, p.seq, p.stamp_ns, p.stamp_unix_ns) == ("robot1", 42, e.stamp_ns, STAMP.unix_ns)
    assert (p.x_m, p.y_m, p.theta_rad) == tuple(e.pose)
    assert p.cov == tuple(e.cov.ravel())
    assert (p.state, p.quality, p.reason, p.nis, p.ess) == (State.TRACKING, 0.97, "", 1.1, 71.5)


@given(st.lists(st.floats(width=64), min_size=12, max_size=12))
def test_any_pose_survives_and_what_is_not_finite_is_null(values: list[float]) -> None:
    e = replace(estimate(), pose=np.array(values[:3]), cov=np.array(values[3:]).reshape(3, 3))
    raw = messages.encode_pose("r", e, 1, 2)
    p = messages.decode_pose(raw)
    assert b"NaN" not in raw
    assert b"Infinity" not in raw
    for got, sent in zip((p.x_m, p.y_m, p.theta_rad, *p.cov), values, strict=True):
        assert got == sent if math.isfinite(sent) else math.isnan(got)


def test_odd_counters_become_plain_json() -> None:
    odd = {
        "i": np.int64(3), "f": np.float32(0.5), "b": np.bool_(True), "nan": math.nan, "state": State.LOST, "n": None,
        "list": [np.inf, 1], "array": np.array([1.0, np.nan]), "path": Path("a/b"), "deep": {1: (2,)}, "text": "\ud800",
    }  # fmt: skip
    counters = json.loads(messages.encode_health("r", STAMP, 1.0, State.LOST, odd))["counters"]
    assert counters == {
        "i": 3, "f": 0.5, "b": True, "nan": None, "state": "LOST", "n": None,
        "list": [None, 1], "array": [1.0, None], "path": "a/b", "deep": {"1": [2]}, "text": "\ud800",
    }  # fmt: skip


def test_config_message_has_every_key() -> None:
    fields = json.loads(messages.encode_config("r", Config()))
    assert fields["config"] == json.loads(json.dumps(asdict(Config())))


def test_a_large_particle_set_is_thinned_evenly() -> None:
    n = 3 * messages.MAX_PARTICLES + 1
    poses = np.column_stack([np.arange(n), np.zeros(n), np.zeros(n)]).astype(float)
    fields = json.loads(messages.encode_particles("r", 1, STAMP, poses, np.full(n, 1.0 / n)))
    assert fields["count"] == n
    assert messages.MAX_PARTICLES / 2 < len(fields["x_m"]) == len(fields["weight"]) <= messages.MAX_PARTICLES
    assert set(np.diff(fields["x_m"])) == {4.0}


def test_no_particles() -> None:
    fields = json.loads(messages.encode_particles("r", 1, STAMP, np.empty((0, 3)), np.empty(0)))
    assert (fields["count"], fields["x_m"]) == (0, [])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"schema": "ceilvo.pose.2"}, "schema is 'ceilvo.pose.2'"),
        ({"cov": [1, 2]}, "cov has 2 numbers"),
        ({"cov": None}, "TypeError"),
        ({"state_number": 77}, "77"),
        ({"x_m": "here"}, "ValueError"),
        ({"seq": None}, "TypeError"),
        ({"seq": 1e999}, "payload is not JSON"),
    ],
)
def test_a_pose_of_another_kind_is_refused_in_one_line(change: dict[str, Any], says: str) -> None:
    raw = json.dumps(json.loads(samples()["pose"]) | change).encode()
    with pytest.raises(BusError, match="pose message") as caught:
        messages.decode_pose(raw)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_pose_without_a_field_is_refused() -> None:
    fields = json.loads(samples()["pose"])
    del fields["y_m"]
    with pytest.raises(BusError, match="KeyError 'y_m'"):
        messages.decode_pose(json.dumps(fields).encode())


def test_readers_ignore_fields_of_the_future() -> None:
    fields = json.loads(samples()["pose"]) | {"warp_factor": 9}
    assert messages.decode_pose(json.dumps(fields).encode()).seq == 42


@pytest.mark.parametrize("prefix, robot", [("ceilvo", "robot1"), ("site-3", "Löwe_7")])
def test_keys(prefix: str, robot: str) -> None:
    assert messages.robot_key(prefix, robot) == f"{prefix}/{robot}"


@pytest.mark.parametrize("bad", ["", "a/b", "*", "a*", "a$b", "a#", "a?b", "@x", "a b", "a\n", "a\x7f"])
def test_names_that_cannot_be_in_a_key(bad: str) -> None:
    with pytest.raises(BusError, match=r"^robot\.name: found "):
        messages.robot_key("ceilvo", bad)
    with pytest.raises(BusError, match=r"^zenoh\.prefix: found "):
        messages.robot_key(bad, "robot1")


# commands


def test_initial_pose() -> None:
    got = parse_command("initial_pose", b'{"x_m": 1, "y_m": -2.5, "theta_rad": 0.5}')
    assert got == InitialPose(1.0, -2.5, 0.5, sigma_m=0.25, sigma_theta_rad=0.15)


def test_initial_pose_with_sigmas_and_an_angle_beyond_a_turn() -> None:
    raw = json.dumps({"x_m": 0, "y_m": 0, "theta_rad": 2 * math.pi + 1, "sigma_m": 2, "sigma_theta_rad": 3.0})
    got = parse_command("initial_pose", raw.encode())
    assert isinstance(got, InitialPose)
    assert got.theta_rad == pytest.approx(1.0)
    assert (got.sigma_m, got.sigma_theta_rad) == (2.0, 3.0)


@pytest.mark.parametrize("payload", [b"", b"  \n", b"{}"])
@pytest.mark.parametrize(
    ("name", "expected"), [("relocalise", Relocalise()), ("save_map", SaveMap()), ("reset", Reset())]
)
def test_commands_without_fields(name: str, expected: commands.Command, payload: bytes) -> None:
    assert parse_command(name, payload) == expected


def test_reset_keeps_the_map_unless_told() -> None:
    assert Reset().keep_map is True
    assert parse_command("reset", b'{"keep_map": false}') == Reset(keep_map=False)


POSE = b'{"x_m": 1, "y_m": 2, "theta_rad": 3%s}'


@pytest.mark.parametrize(
    ("name", "payload", "says"),
    [
        ("initial_pose", b"", "x_m is missing"),
        ("initial_pose", b'{"x_m": 1, "y_m": 2}', "theta_rad is missing"),
        ("initial_pose", POSE % b', "z_m": 1', "field 'z_m' is unknown"),
        ("initial_pose", POSE % b', "x_m": 2', "given twice"),
        ("initial_pose", POSE % b', "sigma_m": NaN', "NaN is not a JSON number"),
        ("initial_pose", POSE % b', "sigma_m": -Infinity', "-Infinity is not a JSON number"),
        ("initial_pose", POSE % b', "sigma_m": 1e999', "sigma_m is inf"),
        ("initial_pose", POSE % b', "sigma_m": 0', "sigma_m is 0, expected a number in [0.0001, 100]"),
        ("initial_pose", POSE % b', "sigma_m": true', "sigma_m is True"),
        ("initial_pose", POSE % b', "sigma_m": "1"', "sigma_m is '1'"),
        ("initial_pose", POSE % b', "sigma_m": null', "sigma_m is None"),
        ("initial_pose", POSE % (b', "sigma_m": 1' + b"0" * 400), "expected a number in"),
        ("initial_pose", b'{"x_m": 1e6, "y_m": 2, "theta_rad": 3}', "x_m is 1000000.0"),
        ("initial_pose", b"[1, 2, 3]", "expected a JSON object"),
        ("initial_pose", b"{", "not JSON"),
        ("initial_pose", b"\xff\xfe{\x00}\x00", "not JSON"),
        ("initial_pose", b'{"\\ud800\\u001b[2J": 1}', "is unknown"),
        ("reset", b'{"keep_map": 0}', "keep_map is 0, expected true or false"),
        ("reset", b'{"keep-map": false}', "expected only keep_map"),
        ("relocalise", b'{"now": true}', "expected no fields"),
        ("save_map", b"null", "payload is None"),
        ("save_map", b"[" * MAX_COMMAND_BYTES, "not JSON"),
        ("save_map", b" " * (MAX_COMMAND_BYTES + 1), "payload too large, expected at most 4096 bytes"),
        ("self_destruct", b"", "unknown, expected one of initial_pose"),
    ],
)
def test_bad_commands_are_refused_in_one_printable_line(name: str, payload: bytes, says: str) -> None:
    with pytest.raises(BusError, match=r"^command ") as caught:
        parse_command(name, payload)
    assert says in str(caught.value)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("name", commands.COMMANDS)
def test_no_command_by_wildcard(name: str) -> None:
    with pytest.raises(BusError, match="wildcard"):
        parse_command(name, b"", exact=False)


@given(st.sampled_from(commands.COMMANDS), st.binary(max_size=200) | st.text(max_size=200).map(str.encode))
def test_any_bytes_are_a_command_or_a_bus_error(name: str, payload: bytes) -> None:
    try:
        got = parse_command(name, payload)
    except BusError:
        return
    assert isinstance(got, InitialPose | Relocalise | SaveMap | Reset)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


@given(st.dictionaries(st.sampled_from(["x_m", "y_m", "theta_rad", "sigma_m", "sigma_theta_rad"]), JSON))
def test_an_accepted_initial_pose_is_finite_and_in_range(fields: dict[str, Any]) -> None:
    try:
        got = parse_command("initial_pose", json.dumps(fields).encode())
    except BusError:
        return
    assert isinstance(got, InitialPose)
    assert abs(got.x_m) <= 1e5
    assert abs(got.y_m) <= 1e5
    assert -math.pi <= got.theta_rad < math.pi
    assert got.sigma_m > 0
    assert got.sigma_theta_rad > 0
