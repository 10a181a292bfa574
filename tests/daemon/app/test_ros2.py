"""The daemon read by ROS 2 programs that others wrote, each in a process of its own: zenoh-ros2-sdk, Cyclone DDS."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from patience import until
from ros2_parts import UNIX_NS, estimate, parts
from simulated_daemon import SimulatedDaemon

from ceilvo import se2
from ceilvo.bench.soak.parts import free_port
from ceilvo.bench.wires.router import Router, as_ros
from ceilvo.drivers.bus import messages
from ceilvo.drivers.ros2.cdr import Cdr
from ceilvo.drivers.ros2.naming import RmwZenoh
from ceilvo.types import State

pytest.importorskip("zenoh_ros2_sdk")

POSES = 60
"""To compare; two of them a wire are enough to see a mistake, so many a loss."""
SOON = "camera.rate_hz=20"
"""For tests that wait for many."""
IMPATIENT = """
import runpy, sys
from ceilvo.drivers.bus import namesake
namesake.refuse_namesake.__defaults__ = (1.5,)
del sys.argv[:3]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)
"""
"""A daemon that waits less for the last sign of one of its name; tests/drivers/bus/test_routers.py waits for it."""


class Told:
    """A program that is told by lines and tells all at its end."""

    def __init__(self, words: Sequence[str], **environment: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**os.environ, **environment},
        )  # fmt: skip
        self.wait_for("ready")

    def wait_for(self, word: str) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == f"{word}\n"

    def tell(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        self.wait_for("done")

    def end(self) -> dict[str, Any]:
        """All that it heard."""
        told, _ = self._process.communicate("end\n")
        return dict(json.loads(told.splitlines()[-1]))

    def __enter__(self) -> Told:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()


@pytest.fixture
def router() -> Iterator[Router]:
    with Router(free_port()) as made:
        yield made


def json_poses(router: Router) -> tuple[zenoh.Session, dict[int, dict[str, Any]]]:
    """By the time of their pictures, as another program behind the router gets them."""
    session, got = zenoh.open(as_ros(router.end)), {}  # type: ignore[var-annotated]

    def take(sample: zenoh.Sample) -> None:
        fields = messages.decode(sample.payload.to_bytes(), "pose")
        got[fields["stamp_unix_ns"]] = fields

    session.declare_subscriber("ceilvo/robot1/pose", take)
    return session, got


def test_a_program_of_ros_sees_the_node_and_every_pose_as_json_has_it(tmp_path: Path, router: Router) -> None:
    wires = (f"zenoh.connect=[{router.end}]", "zenoh.wire=[json,rmw_zenoh,ros2dds]", "ros2.odom_to_base=true", SOON)
    session, told = json_poses(router)
    with SimulatedDaemon(tmp_path / "state", tmp_path, *wires) as daemon:
        daemon.until_poses(10)
        with Told(["ceilvo.bench.wires.reader", str(router.port)]) as reader:
            daemon.until_poses(POSES)
            reader.tell("graph")
            heard = reader.end()
        assert daemon.end() == 0
    session.close()
    assert heard["warnings"] == []
    poses = heard["poses"]
    first, last = poses[0][0], poses[-1][0]
    expected = [told[t] for t in sorted(told) if first <= t <= last]
    assert len(poses) >= POSES and [p[0] for p in poses] == [t["stamp_unix_ns"] for t in expected], "100 % of them"
    for pose, fields in zip(poses, expected, strict=True):
        assert np.allclose(pose[1:4], [fields["x_m"], fields["y_m"], fields["theta_rad"]], atol=1e-9)
        if fields["state"] == "TRACKING":
            assert np.allclose([pose[4 + i] for i in (0, 1, 5, 6, 7, 11, 30, 31, 35)], fields["cov"], atol=1e-15)
    chains(heard["transforms"], told)
    static = [t for t in heard["transforms"] if t[2] == "ceiling_camera_optical_frame"]
    assert static and static[0][1] == "base_link", "the late reader was given what was said before it came"
    assert {s["state"] for s in heard["states"]} <= {"INIT", "TRACKING", "DEGRADED"} and heard["states"]
    graph = heard["graph"]
    assert graph["/pose"]["types"] == ["geometry_msgs/msg/PoseWithCovarianceStamped"]
    [[node, _, kind, qos]] = graph["/pose"]["publishers"]
    assert (node, qos) == ("ceilvo", "1:1:1,1:,:,:,,")
    assert kind == Cdr().hash("geometry_msgs/msg/PoseWithCovarianceStamped")
    assert {"/tf", "/tf_static", "/odom", "/diagnostics", "/camera_info", "/landmarks"} <= set(graph)
    assert set(graph["services"]) == {"/reinitialize_global_localization", "/save_map"}


def chains(transforms: list[list[Any]], told: dict[int, dict[str, Any]]) -> None:
    """map -> odom -> base_link, composed by the reader, is the JSON pose within 1e-6."""
    tolerance_ns = 100_000_000
    by_stamp: dict[int, dict[str, np.ndarray[Any, Any]]] = {}
    for stamp_ns, _, child, *pose in transforms:
        at = stamp_ns - tolerance_ns * (child == "odom")
        by_stamp.setdefault(at, {})[child] = np.array(pose)
    whole = [(t, c) for t, c in by_stamp.items() if {"odom", "base_link"} <= set(c) and t in told]
    assert len(whole) >= POSES // 2
    for stamp_ns, chain in whole:
        fields = told[stamp_ns]
        found = se2.compose(chain["odom"], chain["base_link"])
        pose = np.array([fields["x_m"], fields["y_m"], fields["theta_rad"]])
        assert np.abs(se2.between(found, pose)).max() < 1e-6


def test_a_pose_and_a_saving_that_a_program_of_ros_asks_for(tmp_path: Path, router: Router) -> None:
    state = tmp_path / "state"
    state.mkdir()
    wires = (f"zenoh.connect=[{router.end}]", "zenoh.wire=[json,rmw_zenoh]", "service.state_period_s=3600", SOON)
    with SimulatedDaemon(state, tmp_path, *wires) as daemon:
        daemon.until_poses(30)
        with Told(["ceilvo.bench.wires.reader", str(router.port)]) as reader:
            reader.tell("save_map")
            before = daemon.poses[-1]
            reader.tell(f"initialpose {before.x_m + 5.0} {before.y_m - 4.0} 1.0")
            daemon.until(lambda: any(p.x_m > before.x_m + 4.0 for p in daemon.poses), "the pose moved")
            heard = reader.end()
        assert daemon.end() == 0
    assert heard["saved"]["success"], heard["saved"]
    assert '"landmarks"' in heard["saved"]["message"]
    assert heard["warnings"] == []
    assert "initial_pose by this computer" in daemon.said()


def bad_poses() -> dict[str, tuple[bytes, str]]:
    """What another program may send by mistake to /initialpose, and what is said of it."""
    p = parts()
    pose = p.conversion.pose(estimate(pose=np.array([3.0, -2.0, 1.0])), UNIX_NS)
    good = p.cdr.encode(pose)
    pose.header.frame_id = "odom"
    other = p.cdr.encode(pose)
    pose.header.frame_id, pose.pose.pose.position.x = "map", np.nan
    no_number = p.cdr.encode(pose)
    return {
        "cut": (good[:-9], "expected its CDR"),
        "noise": (np.random.default_rng(3).bytes(len(good)), "expected its CDR"),
        "frame": (other, "header.frame_id: found 'odom', expected 'map'"),
        "nan": (no_number, "not finite"),
        "type": (good, "found another type"),
    }


def test_bad_input_is_counted_said_in_a_line_each_and_changes_nothing(tmp_path: Path, router: Router) -> None:
    wires = (f"zenoh.connect=[{router.end}]", "zenoh.wire=[json,rmw_zenoh]")
    bad, p = bad_poses(), parts()
    key = RmwZenoh(p.config, p.cdr).key(p.ends.initial_pose)
    with SimulatedDaemon(tmp_path / "state", tmp_path, *wires) as daemon:
        daemon.until(lambda: daemon.poses and daemon.poses[-1].state is State.TRACKING, "it knows where it is")
        session = zenoh.open(as_ros(router.end))
        keys = (key, key.replace("PoseWithCovarianceStamped", "PoseStamped"), "ceilvo/robot1/pose")
        pose, other_type, robots_own = (session.declare_publisher(k) for k in keys)
        for publisher in (pose, other_type, robots_own):
            daemon.until(lambda p=publisher: p.matching_status.matching, "the daemon hears it")  # type: ignore[misc]
        for name, (payload, _) in bad.items():
            for _ in range(3):
                (other_type if name == "type" else pose).put(payload)
        robots_own.put(b"another's")

        def counted() -> bool:
            ros2 = daemon.health("ros2")
            return isinstance(ros2, dict) and ros2["malformed"] == 3 * len(bad)

        daemon.until(counted, "all are counted")
        daemon.until_poses(10)
        ros2 = daemon.health("ros2")
        assert isinstance(ros2, dict) and (ros2["taken"], ros2["refused"], ros2["errors"]) == (0, 0, 0)
        poses = [row for row in daemon.poses if row.state is State.TRACKING]
        daemon.until(lambda: "found a publication of another session" in daemon.said(), "the other speaker is named")
        session.close()
        assert daemon.end() == 0
    way_m = np.hypot(*np.diff([(row.x_m, row.y_m) for row in poses], axis=0).T)
    assert way_m.max() < 0.5, "no pose jumped"
    lines = [line for line in daemon.said().splitlines() if "; nothing was done" in line and "initialpose" in line]
    assert len(lines) == 3 * len(bad)
    for _, says in bad.values():
        assert any(says in line for line in lines), says


def test_open_rmfs_reader_of_transforms(tmp_path: Path, router: Router) -> None:
    """free_fleet subscribes to <robot>/tf and looks up map -> base_footprint in what it got there."""
    session, told = json_poses(router)
    found: list[tuple[int, np.ndarray[Any, Any]]] = []
    cdr = Cdr()

    def look_up(sample: zenoh.Sample) -> None:
        known = {}
        for t in cdr.decode(sample.payload.to_bytes(), "tf2_msgs/msg/TFMessage").transforms:
            v, q = t.transform.translation, t.transform.rotation
            at = t.header.stamp.sec * 10**9 + t.header.stamp.nanosec
            known[t.child_frame_id] = (at, t.header.frame_id, np.array([v.x, v.y, 2.0 * np.arctan2(q.z, q.w)]))
        at, parent, pose = known["base_footprint"]
        while parent != "map":
            _, parent, above = known[parent]
            pose = se2.compose(above, pose)
        found.append((at, pose))

    session.declare_subscriber("robot1/tf", look_up)
    wires = (f"zenoh.connect=[{router.end}]", "ros2.fleet_tf=true")
    with SimulatedDaemon(tmp_path / "state", tmp_path, *wires) as daemon:
        daemon.until(lambda: len([at for at, _ in found if at in told]) >= 20, "20 look-ups of known poses")
        assert daemon.end() == 0
    session.close()
    for at, pose in found:
        if at in told:
            expected = np.array([told[at]["x_m"], told[at]["y_m"], told[at]["theta_rad"]])
            assert np.abs(se2.between(pose, expected)).max() < 1e-6


def test_a_second_daemon_behind_the_same_router_ends_with_78(tmp_path: Path, router: Router) -> None:
    (tmp_path / "second").mkdir()
    with SimulatedDaemon(tmp_path / "state", tmp_path, f"zenoh.connect=[{router.end}]") as first:
        first.until_poses(1)
        folder, enter = tmp_path / "second", (sys.executable, "-c", IMPATIENT)
        with SimulatedDaemon(tmp_path / "other", folder, f"zenoh.connect=[{router.end}]", enter=enter) as second:
            until(lambda: second.process.poll() is not None, "it gives up")
            assert second.process.returncode == 78
            assert "expected no other daemon of this name on the network" in second.said()
        first.until_poses(5)
        assert first.end() == 0


def test_a_participant_of_dds_in_another_process(tmp_path: Path) -> None:
    pytest.importorskip("cyclonedds", reason="no wheel for this computer")
    domain = 90 + os.getpid() % 100
    with SimulatedDaemon(tmp_path / "state", tmp_path, "ros2.dds=true", f"ros2.domain_id={domain}", SOON) as daemon:
        daemon.until_poses(5)
        with Told(["ceilvo.bench.wires.dds_reader", str(domain)]) as reader:
            daemon.until_poses(POSES)
            before = daemon.poses[-1]
            reader.tell(f"initialpose {before.x_m + 5.0} {before.y_m - 4.0} 1.0")
            daemon.until(lambda: any(p.x_m > before.x_m + 4.0 for p in daemon.poses), "the pose moved")
            heard = reader.end()
        known = {(p.x_m, p.y_m) for p in daemon.poses}
        assert daemon.end() == 0
    poses = heard["poses"]
    assert len(poses) >= POSES - 5 and all((x, y) in known for _, x, y, _ in poses[: POSES - 5]), "as JSON has them"
    assert [t[2] for t in heard["static"]] == ["ceiling_camera_optical_frame"], "said before the reader came"
