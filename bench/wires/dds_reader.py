"""A participant of DDS (Cyclone DDS) in a process of its own: `python -m ceilvo.bench.wires.dds_reader DOMAIN`.

It says "ready", takes `initialpose X Y THETA` and `end`, and prints what it heard as one line of JSON.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import threading
from typing import Any

_PATIENCE_S = 20.0
"""For somebody to send a pose to."""


class Reader:
    """Its types are Cyclone's own; it reads /pose and /tf_static."""

    def __init__(self, domain: int) -> None:
        from cyclonedds.domain import Domain, DomainParticipant
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        from ceilvo.config import Ros2
        from ceilvo.drivers.ros2.cdr import Cdr
        from ceilvo.drivers.ros2.dds import LOOPBACK, IdlClasses, qos
        from ceilvo.drivers.ros2.endpoints import endpoints

        ends, self._classes = endpoints(Ros2(), "robot1"), IdlClasses(Cdr().store)
        self._domain = Domain(domain, LOOPBACK.format(address="127.0.0.1"))
        participant = DomainParticipant(domain)

        def topic(endpoint: Any) -> Any:
            return Topic(participant, f"rt{endpoint.topic}", self._classes.of(endpoint.message))

        self._pose = DataReader(participant, topic(ends.pose), qos=qos(ends.odom, depth=10_000))
        self._static = DataReader(participant, topic(ends.tf_static), qos=qos(ends.tf_static))
        self._initial = DataWriter(participant, topic(ends.initial_pose), qos=qos(ends.initial_pose))

    def initial_pose(self, x_m: float, y_m: float, theta_rad: float) -> None:
        make, patience = self._classes.of, threading.Event()
        for _ in range(int(_PATIENCE_S / 0.05)):
            if self._initial.get_matched_subscriptions():
                break
            patience.wait(0.05)
        header = make("std_msgs/msg/Header")(
            stamp=make("builtin_interfaces/msg/Time")(sec=0, nanosec=0), frame_id="map"
        )
        turn = make("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=math.sin(theta_rad / 2), w=math.cos(theta_rad / 2))
        where = make("geometry_msgs/msg/Pose")(
            position=make("geometry_msgs/msg/Point")(x=x_m, y=y_m, z=0.0), orientation=turn
        )
        pose = make("geometry_msgs/msg/PoseWithCovariance")(pose=where, covariance=[0.0] * 36)
        self._initial.write(make("geometry_msgs/msg/PoseWithCovarianceStamped")(header=header, pose=pose))

    def heard(self) -> dict[str, Any]:
        poses = []
        for m in self._pose.take(N=10_000):
            p, q = m.pose.pose.position, m.pose.pose.orientation
            poses.append([_ns(m.header), p.x, p.y, 2.0 * math.atan2(q.z, q.w)])
        static = [
            [_ns(t.header), t.header.frame_id, t.child_frame_id] for m in self._static.take() for t in m.transforms
        ]
        return {"poses": poses, "static": static}


def _ns(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, epilog="example: python -m ceilvo.bench.wires.dds_reader 0")
    parser.add_argument("domain", type=int, help="ROS_DOMAIN_ID")
    reader = Reader(parser.parse_args().domain)
    print("ready", flush=True)
    for line in sys.stdin:
        words = line.split()
        if words[:1] == ["initialpose"]:
            reader.initial_pose(*map(float, words[1:]))
        elif words == ["end"]:
            break
        print("done", flush=True)
    sys.stdout.write(json.dumps(reader.heard()) + "\n")
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
