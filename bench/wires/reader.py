"""A ROS 2 program that somebody else wrote (zenoh-ros2-sdk), in a process: `python -m ceilvo.bench.wires.reader PORT`.

It says "ready" when its subscriptions stand. It takes the lines `initialpose X Y THETA`, `save_map`, `graph` and `end`;
after the end, or the end of its input, it prints one line of JSON with all that it heard.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from rosbags.typesys import Stores, get_typestore

POSE, TF, ODOM = "geometry_msgs/msg/PoseWithCovarianceStamped", "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"
DIAGNOSTICS, TRIGGER = "diagnostic_msgs/msg/DiagnosticArray", "std_srvs/srv/Trigger"
_ANSWER_S = 20.0
"""Wait at most so long for an answer about the graph, which ends when the router has said everything; the SDK's own
.5 s lose endpoints on a busy computer. Chosen."""

_ASKED = 10
"""Times that the graph is asked for something at most; chosen."""

_T = TypeVar("_T", list[Any], dict[str, Any])


def _steady(ask: Callable[[], _T]) -> _T:
    """What two questions in a row are answered alike: an answer has less in it, or nothing, where a part of it or the
    question went astray on a busy computer."""
    before, now = ask(), ask()
    for _ in range(_ASKED - 2):
        if now and now == before:
            break
        before, now = now, ask()
    return now


class _Kept(logging.Handler):
    """Warnings of the SDK: unknown attachments, hashes, bytes that cannot be decoded."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


class Reader:
    """Everything it heard, as plain values."""

    def __init__(self, port: int, latched: tuple[str, ...] = ("/tf_static",)) -> None:
        from zenoh_ros2_sdk import ROS2Subscriber
        from zenoh_ros2_sdk.qos import QosDurability, QosProfile

        self._port, self._store = port, get_typestore(Stores.ROS2_JAZZY)
        self.warnings = _Kept()
        logging.getLogger("zenoh_ros2_sdk").addHandler(self.warnings)
        self.poses: list[list[float]] = []
        self.transforms: list[list[Any]] = []
        self.odometry: list[list[float]] = []
        self.states: list[dict[str, str]] = []
        heard = {"/pose": (POSE, self._pose), "/tf": (TF, self._tf), "/tf_static": (TF, self._tf)}
        heard |= {"/odom": (ODOM, self._odom), "/diagnostics": (DIAGNOSTICS, self._diagnostics)}

        def subscriber(topic: str) -> Any:
            kind, take = heard[topic]
            durability = QosDurability.TRANSIENT_LOCAL if topic in latched else QosDurability.VOLATILE
            return ROS2Subscriber(
                topic,
                kind,
                take,
                msg_definition=self._definition(kind),
                router_port=port,
                type_hash=self._store.hash_rihs01(kind),
                qos=QosProfile(durability=durability, history_depth=1),
            )

        until = time.monotonic() + _ANSWER_S
        self._subscribers = [subscriber(topic) for topic in latched]
        while not self.transforms and time.monotonic() < until:  # it asks once for what was said before, for .5 to 2 s
            for late in self._subscribers:
                late.close()
            self._subscribers = [subscriber(topic) for topic in latched]
        self._subscribers += [subscriber(topic) for topic in heard if topic not in latched]

    def graph(self) -> dict[str, Any]:
        """Topics with types, and the endpoints of each by node, hash and quality of service."""
        from zenoh_ros2_sdk import discovery

        router: dict[str, Any] = {"router_port": self._port, "timeout": _ANSWER_S}
        out: dict[str, Any] = {}

        def publishers(topic: str) -> list[Any]:
            info = discovery.get_topic_info(topic, verbose=True, **router)
            ends = [] if info is None else info.publishers
            return sorted([p.node_name, p.topic_type, p.type_hash, p.qos] for p in ends)

        for topic, kinds in _steady(lambda: dict(discovery.get_topic_names_and_types(**router))).items():
            out[topic] = {"types": kinds, "publishers": _steady(partial(publishers, topic))}
        return out | {"services": _steady(lambda: dict(discovery.get_service_names_and_types(**router)))}

    def initial_pose(self, x_m: float, y_m: float, theta_rad: float) -> None:
        from zenoh_ros2_sdk import ROS2Publisher

        make = self._store.types
        publisher = ROS2Publisher(
            "/initialpose",
            POSE,
            msg_definition=self._definition(POSE),
            router_port=self._port,
            type_hash=self._store.hash_rihs01(POSE),
        )
        header = make["std_msgs/msg/Header"](
            stamp=make["builtin_interfaces/msg/Time"](sec=0, nanosec=0), frame_id="map"
        )
        pose = make["geometry_msgs/msg/Pose"](
            position=make["geometry_msgs/msg/Point"](x=x_m, y=y_m, z=0.0),
            orientation=make["geometry_msgs/msg/Quaternion"](
                x=0.0, y=0.0, z=math.sin(theta_rad / 2), w=math.cos(theta_rad / 2)
            ),
        )
        import numpy as np

        covariance = np.zeros(36)
        covariance[[0, 7, 35]] = 0.25, 0.25, 0.0685
        publisher.publish(
            header=header, pose=make["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=covariance)
        )

    def save_map(self) -> dict[str, Any]:
        from zenoh_ros2_sdk import ROS2ServiceClient

        client = ROS2ServiceClient(
            "/save_map",
            TRIGGER,
            request_definition="uint8 structure_needs_at_least_one_member",
            response_definition="bool success\nstring message",
            router_port=self._port,
            timeout=20.0,
        )
        answer: Any = client.call(structure_needs_at_least_one_member=0)
        return {} if answer is None else {"success": bool(answer.success), "message": str(answer.message)}

    def _definition(self, kind: str) -> str:
        return self._store.generate_msgdef(kind, ros_version=2)[0]

    def _pose(self, m: Any) -> None:
        p, q = m.pose.pose.position, m.pose.pose.orientation
        self.poses.append([_ns(m.header), p.x, p.y, 2.0 * math.atan2(q.z, q.w), *map(float, m.pose.covariance)])

    def _odom(self, m: Any) -> None:
        p, q = m.pose.pose.position, m.pose.pose.orientation
        self.odometry.append([_ns(m.header), p.x, p.y, 2.0 * math.atan2(q.z, q.w)])

    def _tf(self, m: Any) -> None:
        for t in m.transforms:
            v, q = t.transform.translation, t.transform.rotation
            turn = 2.0 * math.atan2(q.z, q.w)
            self.transforms.append([_ns(t.header), t.header.frame_id, t.child_frame_id, v.x, v.y, turn])

    def _diagnostics(self, m: Any) -> None:
        self.states.append({v.key: v.value for v in m.status[0].values})


def _ns(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, epilog="example: python -m ceilvo.bench.wires.reader 7447")
    parser.add_argument("port", type=int, help="of the router on this computer")
    reader = Reader(parser.parse_args().port)
    print("ready", flush=True)
    saved: dict[str, Any] = {}
    graph: dict[str, Any] = {}
    for line in sys.stdin:
        words = line.split()
        if words[:1] == ["initialpose"]:
            reader.initial_pose(*map(float, words[1:]))
        elif words == ["save_map"]:
            saved = reader.save_map()
        elif words == ["graph"]:
            graph = reader.graph()
        elif words == ["end"]:
            break
        print("done", flush=True)
    out = {
        "poses": reader.poses,
        "transforms": reader.transforms,
        "odometry": reader.odometry,
        "states": reader.states,
        "graph": graph,
        "saved": saved,
        "warnings": reader.warnings.lines,
    }
    sys.stdout.write(json.dumps(out) + "\n")
    sys.stdout.flush()
    os._exit(0)  # the SDK's session ends with its process


if __name__ == "__main__":
    main()
