"""The node: one state, one time and one pose on every wire; what costs work only while somebody subscribes."""

from __future__ import annotations

import json
import queue
import threading
from dataclasses import replace

import numpy as np
import pytest
import zenoh
from link_parts import SETTINGS, received
from patience import PATIENCE_S, until
from ros2_parts import UNIX_NS, Kept, Parts, estimate, parts, scene
from zenoh_world import free_port, peer

from ceilvo import config
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.base.mock_base import BaseModel, MockBase
from ceilvo.drivers.bus import messages
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.ports import Stamp, Topic
from ceilvo.drivers.ros2.naming import RmwZenoh, Ros2dds
from ceilvo.drivers.ros2.transport import FleetTransport, ZenohTransport
from ceilvo.types import Estimate, State

ZERO = np.zeros(3)


def published(kept: Kept, estimates: list[Estimate], **changes: object) -> Parts:
    """All of them through a node's thread."""
    p = parts(kept, **changes)
    p.node.open()
    for e in estimates:
        p.node.publish(e, Stamp(e.stamp_ns, UNIX_NS + e.stamp_ns), scene)
    p.node.close()
    return p


def test_every_estimate_is_sent_in_its_order() -> None:
    kept = Kept()
    p = published(kept, [estimate(seq) for seq in range(42, 72)])
    stamps = [at for e, _, at in kept.sent if e == p.ends.pose]
    assert stamps == [UNIX_NS + estimate(seq).stamp_ns for seq in range(42, 72)]
    assert [len(p.decoded(kept, e)) for e in (p.ends.tf, p.ends.odom)] == [30, 30]
    assert p.node.counters()["dropped"] == p.node.counters()["errors"] == 0


@pytest.mark.parametrize("state", list(State))
def test_a_pose_that_must_not_be_used_moves_no_transform(state: State) -> None:
    kept = Kept()
    p = published(kept, [estimate(state=state)])
    usable = state in (State.TRACKING, State.DEGRADED, State.DEAD_RECKONING)
    assert len(p.decoded(kept, p.ends.tf)) == usable
    assert len(p.decoded(kept, p.ends.pose)) == 1


def test_odometry_to_base_only_when_asked_for() -> None:
    for asked in (False, True):
        kept = Kept()
        p = published(kept, [estimate()], odom_to_base=asked)
        [tf] = p.decoded(kept, p.ends.tf)
        children = [t.child_frame_id for t in tf.transforms]  # type: ignore[attr-defined]
        assert children == (["odom", "base_link"] if asked else ["odom"])


def test_odometrys_covariance_grows_with_the_way_and_the_twists_does_not() -> None:
    kept, steps = Kept(), [estimate(seq, odom=np.array([0.1 * seq, 0.0, 0.0])) for seq in range(42, 62)]
    p = published(kept, steps)
    found = p.decoded(kept, p.ends.odom)
    along, across = ([m.pose.covariance[i] for m in found] for i in (0, 7))  # type: ignore[attr-defined]
    n = np.arange(20)
    assert np.allclose(along[1:], 1e-6 * n[1:])  # of motion.cov
    turn = 3e-6 * 0.1**2 * np.array([sum(k**2 for k in range(i)) for i in n])  # a heading of so far turns every step
    assert np.allclose(across[1:], 2e-6 * n[1:] + turn[1:])
    twists = [m.twist.covariance[0] for m in found[1:]]  # type: ignore[attr-defined]
    assert np.allclose(twists, 1e-6 / 0.033**2)


def test_what_is_not_finite_is_counted_and_not_sent() -> None:
    kept = Kept()
    p = published(kept, [estimate(pose=np.array([np.nan, 0.0, 0.0])), estimate(43)])
    assert len(p.decoded(kept, p.ends.pose)) == 1
    assert p.node.counters()["errors"] == 1


def test_a_wire_that_hangs_loses_old_estimates_and_holds_up_nobody() -> None:
    release = threading.Event()

    class Hanging(Kept):
        def put(self, *sample: object) -> bool:
            assert release.wait(PATIENCE_S)
            return super().put(*sample)  # type: ignore[arg-type]

    kept = Hanging()
    p = parts(kept)
    p.node.open()
    for seq in range(42, 242):
        p.node.publish(estimate(seq), Stamp(0, UNIX_NS + seq), scene)
    dropped = p.node.counters()["dropped"]
    release.set()
    p.node.close()
    assert dropped >= 200 - 64 - 1
    assert max(at for _, _, at in kept.sent) >= UNIX_NS + 241


def test_pictures_are_made_only_for_those_who_look_and_no_oftener_than_their_period() -> None:
    now_ns, made, kept = [0], [0], Kept()

    def counted() -> object:
        made[0] += 1
        return scene()

    p = parts(kept, clock=lambda: now_ns[0], camera_rate_hz=2.0)
    p.node.open()

    def at(t_s: float) -> list[str]:
        now_ns[0] = int(1e9 * t_s)
        before, errors, e = len(kept.sent), p.node.counters()["errors"], estimate()
        p.node.publish(e, Stamp(e.stamp_ns, UNIX_NS), counted)  # type: ignore[arg-type]
        p.node.publish(replace(e, pose=np.full(3, np.nan)), Stamp(0, 0), scene)
        until(lambda: p.node.counters()["errors"] != errors, "the thread is past the first")
        return sorted(x.topic for x, _, _ in kept.sent[before:] if x in p.ends.shown)

    assert at(0.0) == [] and made == [0]
    kept.subscribed = {p.ends.image, p.ends.camera_info}
    assert [at(t) for t in (1.0, 1.4)] == [["/camera_info", "/image/compressed"], []] and made == [1]
    assert at(1.6) == ["/camera_info", "/image/compressed"] and made == [2]
    kept.subscribed = {p.ends.landmarks, p.ends.particles}
    assert at(3.0) == ["/landmarks", "/particles"]
    picture_ns = next(at_ns for x, _, at_ns in kept.sent if x == p.ends.image)
    assert picture_ns == UNIX_NS - estimate().stamp_ns + scene().picture_ns, "when it was taken, not when it is sent"
    p.node.close()


def test_one_state_one_time_and_one_pose_on_json_both_ros_wires_and_modbus() -> None:
    """The same sequence number of each, as real subscribers and a base get it."""
    p = parts(fleet_tf=True)
    bus_end = free_port()
    namings = (RmwZenoh(p.config, p.cdr), Ros2dds())
    on_zenoh = [ZenohTransport(n, p.ends, dict) for n in namings]
    fleet = FleetTransport(p.ends)
    p = parts(*on_zenoh, fleet, fleet_tf=True)
    cfg = replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{bus_end}",), multicast=False, wire=("json", "rmw_zenoh"))
    bus = ZenohBus(cfg, "robot1", p.robot.handlers(), speakers=[t.declare for t in (*on_zenoh, fleet)])
    bus.open()
    p.node.open()
    session = peer(connect=bus_end)
    inbox: dict[str, queue.Queue[zenoh.Sample]] = {}
    keys = {"json": "ceilvo/robot1/pose", "rmw": namings[0].key(p.ends.pose), "dds": namings[1].key(p.ends.pose)}
    keys |= {"tf": namings[1].key(p.ends.tf), "fleet": "robot1/tf"}
    for name, key in keys.items():
        inbox[name] = queue.Queue()
        session.declare_subscriber(key, inbox[name].put)
    base = MockBase(BaseModel(clock=lambda: 0), timeout_s=0.01)
    link = BaseLink(SETTINGS, base, lambda: 5_000_000_000, lambda e: None)
    link.start()
    try:
        until(lambda: bus.wanted(Topic.POSE), "the JSON reader")
        until(lambda: all(on_zenoh[i].wanted(p.ends.odom) is False for i in (0, 1)), "nobody reads odom")
        e = estimate(4242, stamp_ns=4_990_000_000, state=State.DEGRADED)
        stamp = Stamp(e.stamp_ns, UNIX_NS)
        bus.put(Topic.POSE, messages.encode_pose("robot1", e, stamp.unix_ns, e.stamp_ns))
        p.node.publish(e, stamp, scene)
        p.node.health(UNIX_NS, e.state, {})
        link.submit(e)
        got = {name: box.get(timeout=PATIENCE_S) for name, box in inbox.items()}
        until(lambda: any(t.sequence == 4242 for t in received(base)), "the base has it")
    finally:
        link.stop()
        session.close()
        bus.close()
        p.node.close()
    told = json.loads(got["json"].payload.to_bytes())
    assert (told["seq"], told["state"], told["stamp_unix_ns"]) == (4242, "DEGRADED", UNIX_NS)
    assert got["rmw"].payload.to_bytes() == got["dds"].payload.to_bytes()
    ros = p.cdr.decode(got["dds"].payload.to_bytes(), p.ends.pose.message)
    assert ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec == told["stamp_unix_ns"]
    q, v = ros.pose.pose.orientation, ros.pose.pose.position
    assert np.allclose([v.x, v.y, 2 * np.arctan2(q.z, q.w)], [told["x_m"], told["y_m"], told["theta_rad"]], atol=1e-12)
    assert np.allclose(ros.pose.covariance[[0, 1, 5, 6, 7, 11, 30, 31, 35]], told["cov"])
    attached = got["rmw"].attachment
    assert attached is not None and len(attached.to_bytes()) == 33 and got["dds"].attachment is None
    telegram = next(t for t in received(base) if t.sequence == 4242)
    assert telegram.state is State.DEGRADED
    assert np.allclose([telegram.x_m, telegram.y_m, telegram.theta_rad], [v.x, v.y, 0.75], atol=1e-4)
    chain = p.cdr.decode(got["fleet"].payload.to_bytes(), p.ends.tf.message).transforms
    assert [t.child_frame_id for t in chain] == ["odom", "base_footprint"]
    assert [t.child_frame_id for t in p.cdr.decode(got["tf"].payload.to_bytes(), p.ends.tf.message).transforms] == [
        "odom"
    ]
    assert p.node.counters()["samples"]


def test_the_owners_token_keeps_ros_out() -> None:
    """ROS 2 cannot bring it, so where commands need it a pose of ROS 2's is refused."""
    from ceilvo.drivers.bus.command_guard import CommandGuard
    from ceilvo.drivers.bus.requests import Requests
    from ceilvo.drivers.ros2.intake import Intake

    p = parts()
    guarded = Requests("robot1", p.robot.handlers(), guard=CommandGuard(token=b"0123456789abcdef"))
    intake = Intake(p.config, p.cdr, p.ends, guarded.answer)
    intake.initial_pose("k", p.cdr.encode(p.conversion.pose(estimate(), UNIX_NS)))
    assert p.robot.calls == [] and intake.counters() == {"taken": 0, "malformed": 0, "refused": 1}
