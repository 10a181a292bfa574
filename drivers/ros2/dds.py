"""A ROS 2 node by DDS itself, by Cyclone DDS: for robots whose ROS has no Zenoh. Topics only, no services."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import threading
import time
import types
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ceilvo.config import Ros2
from ceilvo.config.zenoh_names import on_this_computer
from ceilvo.drivers.ros2.cdr import Cdr, dds_name
from ceilvo.drivers.ros2.endpoints import Endpoint, Endpoints
from ceilvo.drivers.ros2.intake import Intake
from ceilvo.errors import BusError, ConfigError, one_line

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

log = logging.getLogger(__name__)

_POLL_NS = 200_000_000
"""Longest that closing waits for the reader; chosen."""
_JOIN_S = 0.5
LOOPBACK = """<CycloneDDS><Domain><General><Interfaces><NetworkInterface address="{address}"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="{address}"/></Peers></Discovery></Domain></CycloneDDS>"""
"""Unicast to the participants of one's own computer, which loopback carries everywhere."""


class DdsTransport:
    """A transport.Transport. Messages go in as CDR and come out as the same CDR."""

    def __init__(
        self, config: Ros2, cdr: Cdr, endpoints: Endpoints, latched: Callable[[], dict[Endpoint, bytes]]
    ) -> None:
        """As ZenohTransport.

        Raises:
            ConfigError: Cyclone DDS is not installed, or has no wheel for this computer.
        """
        try:
            import cyclonedds.idl  # noqa: F401
        except ImportError as e:
            raise ConfigError(
                "ros2.dds: found no cyclonedds, expected it; pip install 'ceilvo[dds]' where it has a wheel (Linux "
                "x86-64), elsewhere set zenoh.wire: [ros2dds] and run zenoh-bridge-ros2dds (docs/ros2.md)"
            ) from e
        self._config, self._endpoints, self._latched = config, endpoints, latched
        self._classes = IdlClasses(cdr.store)
        self._writers: dict[Endpoint, Any] = {}
        self._held: list[Any] = []
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self, intake: Intake) -> None:
        """
        Raises:
            BusError: the domain cannot be joined.
        """
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        c = self._config
        try:
            if c.dds_interface:
                self._held.append(Domain(c.domain_id, LOOPBACK.format(address=c.dds_interface)))
            participant = DomainParticipant(c.domain_id)
            for endpoint in self._endpoints.published:
                topic = Topic(participant, f"rt{endpoint.topic}", self._classes.of(endpoint.message))
                self._writers[endpoint] = DataWriter(participant, topic, qos=qos(endpoint))
            self._held.append(participant)
            for endpoint, payload in self._latched().items():
                self.put(endpoint, payload, time.time_ns())
        except DDSException as e:
            raise BusError(f"ros2.dds: domain {c.domain_id} cannot be joined: {one_line(str(e))}") from e
        if c.dds_interface and on_this_computer(f"udp/{c.dds_interface}:0"):
            self._thread = threading.Thread(target=self._listen, args=(participant, intake), name="dds", daemon=True)
            self._thread.start()
        else:
            log.info("ros2.dds: initialpose is not taken, because DDS has no owner's token and leaves this computer")

    def put(self, endpoint: Endpoint, payload: bytes, unix_ns: int) -> bool:
        writer = self._writers.get(endpoint)
        if writer is None:
            return False
        try:
            writer.write(self._classes.of(endpoint.message).deserialize(payload), timestamp=unix_ns)
        except Exception as e:  # Cyclone's own, of many kinds
            log.debug("%s: %s", endpoint.topic, one_line(str(e)))
            return False
        return True

    def wanted(self, endpoint: Endpoint) -> bool:
        writer = self._writers.get(endpoint)
        return writer is not None and bool(writer.get_matched_subscriptions())

    def close(self) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
        self._writers.clear()
        self._held.clear()

    def _listen(self, participant: Any, intake: Intake) -> None:
        from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        endpoint = self._endpoints.initial_pose
        topic = Topic(participant, f"rt{endpoint.topic}", self._classes.of(endpoint.message))
        reader = DataReader(participant, topic, qos=qos(endpoint))
        waiting = WaitSet(participant)
        waiting.attach(ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Alive))
        while not self._stopping.is_set():
            with contextlib.suppress(Exception):  # a sample that cannot be read is Cyclone's to report
                waiting.wait(_POLL_NS)
                for sample in reader.take(N=10):
                    intake.initial_pose(f"rt{endpoint.topic}", sample.serialize())


class IdlClasses:
    """Cyclone's classes for ROS 2's types, made from rosbags' definitions."""

    def __init__(self, store: Typestore) -> None:
        self._store = store
        self._made: dict[str, Any] = {}

    def of(self, kind: str) -> Any:
        """kind as in geometry_msgs/msg/Pose."""
        if kind not in self._made:
            self._made[kind] = self._make(kind)
        return self._made[kind]

    def _make(self, kind: str) -> Any:
        from cyclonedds.idl import IdlStruct

        members = {name: self._annotation(desc) for name, desc in self._store.fielddefs[kind][1]}
        name = kind.replace("/", "_")
        made = types.new_class(
            name,
            (IdlStruct,),
            {"typename": dds_name(kind).replace("::", ".")},
            lambda body: body.update({"__annotations__": members, "__module__": __name__}),
        )
        return dataclasses.dataclass(made)

    def _annotation(self, desc: Any) -> Any:
        import cyclonedds.idl.types
        from rosbags.interfaces import Nodetype

        idl: Any = cyclonedds.idl.types
        node, rest = desc
        if node == Nodetype.NAME:
            return self.of(rest)
        if node == Nodetype.BASE:
            return (
                str if rest[0] == "string" else bool if rest[0] == "bool" else getattr(idl, _BASE.get(rest[0], rest[0]))
            )
        inner, count = rest
        return (
            idl.array[self._annotation(inner), count]
            if node == Nodetype.ARRAY
            else idl.sequence[self._annotation(inner)]
        )


_BASE = {"octet": "uint8", "byte": "uint8", "char": "uint8"}
"""ROS's names that IDL has otherwise."""


def qos(endpoint: Endpoint, depth: int | None = None) -> Any:
    """As ROS 2 has it for an endpoint."""
    from cyclonedds.qos import Policy, Qos

    durability = Policy.Durability.TransientLocal if endpoint.latched else Policy.Durability.Volatile
    return Qos(Policy.Reliability.Reliable(0), durability, Policy.History.KeepLast(depth or endpoint.depth))
