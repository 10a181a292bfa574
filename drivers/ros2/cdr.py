"""ROS 2's messages, their CDR and their type hashes, by rosbags."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ceilvo.errors import BusError, ConfigError, one_line

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

EMPTY, TRIGGER = "std_srvs/srv/Empty", "std_srvs/srv/Trigger"
_PADDING = "structure_needs_at_least_one_member"
"""The member that ROS 2 gives to a message without any."""
_NO_HASH = "TypeHashNotSupported"
"""What Humble writes in place of a hash."""


class Cdr:
    """The messages of one distribution.

    Attributes:
        store: rosbags' types.
    """

    def __init__(self, distribution: str = "jazzy") -> None:
        """
        Raises:
            ConfigError: rosbags is not installed.
        """
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError as e:
            raise ConfigError(
                "zenoh.wire, ros2: found no rosbags, expected it for ROS 2's messages; pip install 'ceilvo[ros2]'"
            ) from e
        self._hashes = distribution != "humble"
        self.store: Typestore = get_typestore(Stores.ROS2_JAZZY if self._hashes else Stores.ROS2_HUMBLE)
        for name, members in _SERVICE_PARTS.items():
            self.store.register(get_types_from_msg(members, name.replace("/srv/", "/msg/")))
        if self._hashes:
            for service in (EMPTY, TRIGGER):
                describe_service(self.store, service)
        self._hash_of: dict[str, str] = {}

    def make(self, kind: str, **members: Any) -> Any:
        """A message; kind as in geometry_msgs/msg/Pose."""
        return self.store.types[kind](**members)

    def encode(self, message: Any) -> bytes:
        """XCDR1, little endian, with its header of four bytes."""
        return bytes(self.store.serialize_cdr(message, message.__msgtype__))

    def decode(self, payload: bytes, kind: str) -> Any:
        """
        Raises:
            BusError: it is no message of this kind.
        """
        try:
            if len(payload) < 4 or payload[0] != 0 or payload[1] not in (0, 1):
                raise ValueError(f"header is {payload[:4].hex() or 'missing'}")
            return self.store.deserialize_cdr(payload, kind)
        except Exception as e:  # whatever rosbags meets in bytes that are something else
            reason = one_line(str(e)) or type(e).__name__
            raise BusError(f"found {len(payload)} bytes that are no {kind} ({reason}), expected its CDR") from e

    def hash(self, kind: str) -> str:
        """RIHS01 of a message or a service (REP-2016)."""
        if not self._hashes:
            return _NO_HASH
        if kind not in self._hash_of:
            self._hash_of[kind] = self.store.hash_rihs01(kind)
        return self._hash_of[kind]


def describe_service(store: Typestore, service: str) -> None:
    """Add a service to what hash_rihs01() knows: a type with request, response and event. rosbags makes messages only.

    Its request and response must be there as messages, package/msg/Name_Request.
    """
    from rosbags.interfaces import Nodetype

    name, sequence = Nodetype.NAME, Nodetype.SEQUENCE
    defs: dict[str, Any] = {}
    info = "service_msgs/msg/ServiceEventInfo"
    constants, members = store.fielddefs[info]
    as_bytes = (Nodetype.ARRAY, ((Nodetype.BASE, ("uint8", 0)), 16))  # char of a .msg file is IDL's uint8
    defs[info] = (constants, [(n, as_bytes if n == "client_gid" else desc) for n, desc in members])
    request, response = f"{service}_Request", f"{service}_Response"
    for part in (request, response):
        defs[part] = store.fielddefs[part.replace("/srv/", "/msg/")]
    event = [
        ("info", (name, info)),
        ("request", (sequence, ((name, request), 1))),
        ("response", (sequence, ((name, response), 1))),
    ]
    defs[f"{service}_Event"] = ([], event)
    parts = (("request_message", request), ("response_message", response), ("event_message", f"{service}_Event"))
    defs[service] = ([], [(member, (name, kind)) for member, kind in parts])
    store.fielddefs.update(defs)


_SERVICE_PARTS = {
    f"{EMPTY}_Request": f"uint8 {_PADDING}",
    f"{EMPTY}_Response": f"uint8 {_PADDING}",
    f"{TRIGGER}_Request": f"uint8 {_PADDING}",
    f"{TRIGGER}_Response": "bool success\nstring message",
}


def dds_name(kind: str) -> str:
    """geometry_msgs::msg::dds_::Pose_ of geometry_msgs/msg/Pose."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"
