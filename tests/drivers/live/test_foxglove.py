"""A running robot in Foxglove: the websocket as a client of its protocol sees it."""

from __future__ import annotations

import contextlib
import json
import threading
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from patience import PATIENCE_S, until
from ros2_parts import UNIX_NS, calibration, estimate, scene
from zenoh_world import Robot, free_port

from ceilvo import config, se2
from ceilvo.drivers.bus import messages
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.live.foxglove_server import CHANNELS, View, serve
from ceilvo.drivers.ports import Stamp, Topic
from ceilvo.drivers.recording.mcap_file import Channel
from ceilvo.errors import BusError

pytest.importorskip("foxglove")
STAMP = Stamp(0, UNIX_NS)


def decoded(channel: Channel, data: bytes) -> Any:
    decode = DecoderFactory().decoder_for("protobuf", Schema(1, channel.schema, "protobuf", channel.schema_name))
    assert decode is not None
    return decode(data)


def spoken() -> list[tuple[Topic, bytes]]:
    """One of every message of a robot."""
    e, seen = estimate(), scene()
    return [
        (Topic.LANDMARKS, messages.encode_landmarks("robot1", STAMP, seen.landmarks)),
        (Topic.PARTICLES, messages.encode_particles("robot1", 1, STAMP, seen.particles[:1], np.ones(1))),
        (Topic.POSE, messages.encode_pose("robot1", e, UNIX_NS, e.stamp_ns)),
        (Topic.ODOM, messages.encode_odom("robot1", e, UNIX_NS)),
        (Topic.IMAGE, b"\xff\xd8jpeg"),
        (Topic.EVENT, messages.encode_event("robot1", STAMP, "state", "warning", "lost")),
    ]


def test_every_message_becomes_foxgloves() -> None:
    got: dict[str, tuple[Channel, bytes]] = {}
    view = View(lambda channel, data, ns: got.__setitem__(channel.topic, (channel, data)))
    view.calibration(messages.encode_calibration("robot1", calibration()))
    for topic, payload in spoken():
        view.take(topic.value, payload)
    chain = {t.child_frame_id: t for t in decoded(*got["/tf"]).transforms}
    view.take(Topic.HEALTH.value, json.dumps({"schema": "ceilvo.health.1", "stamp_unix_ns": UNIX_NS}).encode())
    view.scene()
    assert {channel for channel, _ in got.values()} == set(CHANNELS)
    assert {"/pose", "/tf", "/scene", "/camera/jpeg", "/event", "/camera/calibration"} <= set(got)
    odom, base = (
        np.array([t.translation.x, t.translation.y, 2 * np.arctan2(t.rotation.z, t.rotation.w)])
        for t in (chain["odom"], chain["base_link"])
    )
    assert np.abs(se2.between(se2.compose(odom, base), estimate().pose)).max() < 1e-9
    entities = {e.id: e for e in decoded(*got["/scene"]).entities}
    assert [(s.pose.position.x, s.pose.position.y, s.pose.position.z) for s in entities["landmarks"].spheres] == [
        (0.5, 1.5, pytest.approx(2.0)),
        (2.0, -1.0, pytest.approx(2.0)),
    ]
    assert len(entities["particles"].arrows) == 1 and len(entities["path"].lines) == 1
    assert decoded(*got["/camera/calibration"]).K[0] == 400.0
    assert decoded(*got["/event"]).message == "lost"


@pytest.mark.parametrize(
    "payload", [b"", b"{}", b'{"schema": "ceilvo.pose.1"}', b'{"schema": "ceilvo.pose.1", "x_m": []}']
)
def test_what_is_not_ceilvos_is_our_error(payload: bytes) -> None:
    with pytest.raises(BusError):
        View(lambda channel, data, ns: None).take("pose", payload)


def test_a_websocket_client_gets_the_running_robot() -> None:
    """Through Zenoh and the websocket: advertised channels, then the messages of those it subscribes to."""
    from websockets.sync.client import connect

    port = free_port()
    cfg = replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{port}",), multicast=False)
    bus, stop, ready = ZenohBus(cfg, "robot1", Robot().handlers()), threading.Event(), threading.Event()
    served: list[int] = []

    def on_ready(on: int) -> None:
        served.append(on)
        ready.set()

    bus.open()
    thread = threading.Thread(target=serve, args=(cfg, "robot1", "127.0.0.1", 0, stop, on_ready))
    thread.start()
    try:
        assert ready.wait(PATIENCE_S)
        until(lambda: bus.wanted(Topic.POSE) and bus.wanted(Topic.LANDMARKS), "it listens")
        with connect(f"ws://127.0.0.1:{served[0]}", subprotocols=["foxglove.sdk.v1"]) as ws:  # type: ignore[list-item]
            advertised = heard(ws)
            assert set(advertised) == {channel.topic for channel in CHANNELS}, "before the robot has said a word"

            def speak() -> None:
                for topic, payload in spoken():
                    bus.put(topic, payload)

            ids = {name: i + 1 for i, name in enumerate(("/tf", "/scene"))}
            wanted = [{"id": ids[name], "channelId": advertised[name]} for name in ids]
            ws.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            got: Counter[int] = Counter()

            def both() -> bool:
                speak()  # again and again: what was said before the server took the subscriptions is not sent
                with contextlib.suppress(TimeoutError):
                    data = ws.recv(0.5)
                    if isinstance(data, bytes) and data[0] == 1:  # message data: subscription, time, payload
                        got[int.from_bytes(data[1:5], "little")] += 1
                return set(got) == set(ids.values())

            until(both, ("messages of both", ids, got))
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        bus.close()


def heard(ws: Any) -> dict[str, int]:
    """Topics and ids of the channels that a server advertises first."""
    while True:
        said = ws.recv(PATIENCE_S)
        if isinstance(said, str) and "channels" in (message := json.loads(said)):
            return {channel["topic"]: channel["id"] for channel in message["channels"]}
