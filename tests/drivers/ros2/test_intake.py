"""What ROS 2 says to the daemon: a pose becomes a command; everything else is counted, said once and does nothing."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
from ros2_parts import UNIX_NS, Parts, estimate, parts

from ceilvo.drivers.bus import commands
from ceilvo.errors import BusError


def rviz(p: Parts, frame: str = "map", **changes: Any) -> bytes:
    """As RViz's tool sends it: sigma 0.5 m and 15 deg."""
    message = p.conversion.pose(estimate(pose=np.array([3.0, -2.0, 1.0])), UNIX_NS)
    message.header.frame_id = frame
    message.pose.covariance[:] = 0.0
    message.pose.covariance[[0, 7, 35]] = [0.25, 0.25, 0.06853892]
    for name, value in changes.items():
        part, _, member = name.partition("_")
        setattr(getattr(message.pose.pose, part), member, value)
    return p.cdr.encode(message)


def test_a_pose_of_rviz_becomes_a_command() -> None:
    p = parts()
    p.intake.initial_pose("/initialpose", rviz(p))
    [call] = p.robot.calls
    assert isinstance(call, commands.InitialPose)
    assert np.allclose(
        [call.x_m, call.y_m, call.theta_rad, call.sigma_m, call.sigma_theta_rad],
        [3.0, -2.0, 1.0, 0.5, np.sqrt(0.06853892)],
    )
    assert p.intake.counters() == {"taken": 1, "malformed": 0, "refused": 0}


def test_without_a_covariance_the_defaults_hold() -> None:
    p = parts()
    message = p.cdr.decode(rviz(p), p.ends.initial_pose.message)
    message.pose.covariance = np.zeros(36)
    p.intake.initial_pose("/initialpose", p.cdr.encode(message))
    assert p.robot.calls == [commands.InitialPose(3.0, -2.0, pytest.approx(1.0))]


def malformed(p: Parts) -> dict[str, tuple[bytes, str]]:
    good = rviz(p)
    cov = p.cdr.decode(good, p.ends.initial_pose.message)
    cov.pose.covariance = np.full(36, np.nan)
    return {
        "nothing": (b"", "header is missing"),
        "no header": (good[4:], "no geometry_msgs/msg/PoseWithCovarianceStamped"),
        "cut short": (good[:-9], "expected its CDR"),
        "too long": (good + bytes(64), "expected its CDR"),
        "much too long": (bytes(5000), "more than 4096 bytes"),
        "noise": (np.random.default_rng(1).bytes(len(good)), "expected its CDR"),
        "a length beyond it": (good[:12] + b"\xff\xff\xff\x7f" + good[16:], "expected its CDR"),
        "another frame": (rviz(p, "odom"), "header.frame_id: found 'odom', expected 'map'"),
        "x is nan": (rviz(p, position_x=np.nan), "not finite"),
        "y is infinite": (rviz(p, position_y=np.inf), "not finite"),
        "no turn": (rviz(p, orientation_z=0.0, orientation_w=0.0), "quaternion of length 0"),
        "on its side": (rviz(p, orientation_x=0.7071, orientation_z=0.0, orientation_w=0.7071), "a lean of 90 deg"),
        "variance is nan": (p.cdr.encode(cov), "covariance"),
    }


@pytest.mark.parametrize("name", list(malformed(parts())))
def test_malformed_poses_do_nothing_and_are_said_in_a_line(name: str, caplog: pytest.LogCaptureFixture) -> None:
    p = parts()
    payload, says = malformed(p)[name]
    with caplog.at_level(logging.WARNING):
        p.intake.initial_pose("0/initialpose", payload)
    assert p.robot.calls == []
    assert p.intake.counters() == {"taken": 0, "malformed": 1, "refused": 0}
    [line] = [r.getMessage() for r in caplog.records]
    assert says in line and line.startswith("0/initialpose: ") and line.endswith("; nothing was done")
    assert "\n" not in line


def test_another_type_on_our_key(caplog: pytest.LogCaptureFixture) -> None:
    p = parts()
    p.intake.initial_pose("0/initialpose/std_msgs::msg::dds_::String_/x", rviz(p), right_type=False)
    assert p.robot.calls == [] and p.intake.counters()["malformed"] == 1
    assert "found another type" in caplog.text


def test_a_flood_of_nonsense_is_not_a_flood_of_lines(caplog: pytest.LogCaptureFixture) -> None:
    p = parts()
    for _ in range(500):
        p.intake.initial_pose("0/initialpose", b"nonsense")
    assert p.intake.counters()["malformed"] == 500
    assert len(caplog.records) <= p.intake.LOG_BURST + 1


def test_what_the_daemon_refuses_is_counted() -> None:
    p = parts()
    p.robot.refuse = BusError("not now")
    p.intake.initial_pose("/initialpose", rviz(p))
    assert p.intake.counters() == {"taken": 0, "malformed": 0, "refused": 1}


def test_services() -> None:
    p = parts()
    empty = p.cdr.encode(p.cdr.make("std_srvs/msg/Empty_Request", structure_needs_at_least_one_member=0))
    answer = p.intake.call(p.ends.relocalise, "k", empty)
    assert answer is not None and answer.hex() == "0001000000"
    saved = p.intake.call(p.ends.save_map, "k", empty)
    assert saved is not None
    told = p.cdr.decode(saved, "std_srvs/msg/Trigger_Response")
    assert told.success and "SaveMap" in told.message
    assert [type(c) for c in p.robot.calls] == [commands.Relocalise, commands.SaveMap]


def test_services_that_fail_say_so_where_they_can() -> None:
    p = parts()
    p.robot.refuse = BusError("no landmarks yet")
    assert p.intake.call(p.ends.relocalise, "k", b"") is None
    saved = p.intake.call(p.ends.save_map, "k", b"")
    assert saved is not None
    told = p.cdr.decode(saved, "std_srvs/msg/Trigger_Response")
    assert not told.success and "no landmarks yet" in told.message


def test_a_wildcard_calls_no_service() -> None:
    p = parts()
    assert p.intake.call(p.ends.relocalise, "k", b"", exact=False) is None
    assert p.intake.call(p.ends.relocalise, "k", bytes(4097)) is None
    assert p.intake.call(p.ends.relocalise, "k", b"\1\2") is None
    assert p.robot.calls == [] and p.intake.counters()["malformed"] == 3
