"""Keys, liveliness tokens and attachments by which ROS 2's two ways over Zenoh know a node (docs/ros2.md)."""

from __future__ import annotations

import struct
from typing import Protocol

from ceilvo.config import Ros2
from ceilvo.drivers.ros2.cdr import Cdr, dds_name
from ceilvo.drivers.ros2.endpoints import Endpoint, Kind
from ceilvo.errors import ConfigError

_RMW_RELIABLE, _RMW_TRANSIENT_LOCAL, _RMW_VOLATILE, _RMW_KEEP_LAST = 1, 1, 2, 1
"""Of rmw/types.h."""
_DDS_RELIABLE, _DDS_TRANSIENT_LOCAL, _DDS_VOLATILE, _DDS_KEEP_LAST = 1, 1, 0, 0
"""Of the DDS specification, as Cyclone DDS numbers them."""
_GID_BYTES = 16


class Naming(Protocol):
    """How endpoints are called on a wire."""

    attaches: bool
    """Samples carry sequence, time and the publisher's identity."""

    def key(self, endpoint: Endpoint) -> str: ...

    def any_type_key(self, endpoint: Endpoint) -> str:
        """Also what somebody sends there under another type."""

    def token(self, endpoint: Endpoint, zid: str, number: int) -> str: ...

    def node_token(self, zid: str) -> str:
        """ "" where nodes have none."""


class RmwZenoh:
    """rmw_zenoh from Jazzy's 0.2.4 on."""

    attaches = True

    def __init__(self, config: Ros2, cdr: Cdr) -> None:
        self._domain, self._node, self._cdr = config.domain_id, config.node, cdr
        self._namespace = _mangled(f"/{config.namespace.strip('/')}") if config.namespace else "%"

    def key(self, endpoint: Endpoint) -> str:
        e = endpoint
        return f"{self._domain}/{e.topic.strip('/')}/{dds_name(e.message)}/{self._cdr.hash(e.message)}"

    def any_type_key(self, endpoint: Endpoint) -> str:
        return f"{self._domain}/{endpoint.topic.strip('/')}/*/*"

    def token(self, endpoint: Endpoint, zid: str, number: int) -> str:
        e = endpoint
        durability = _RMW_TRANSIENT_LOCAL if e.latched else _RMW_VOLATILE
        qos = f"{_RMW_RELIABLE}:{durability}:{_RMW_KEEP_LAST},{e.depth}:,:,:,,"
        head = f"@ros2_lv/{self._domain}/{zid}/0/{number}/{e.kind.value}/%/{self._namespace}/{self._node}"
        return f"{head}/{_mangled(e.topic)}/{dds_name(e.message)}/{self._cdr.hash(e.message)}/{qos}"

    def node_token(self, zid: str) -> str:
        return f"@ros2_lv/{self._domain}/{zid}/0/0/NN/%/{self._namespace}/{self._node}"


class Ros2dds:
    """zenoh-bridge-ros2dds, which makes routes for the tokens of another bridge: this one."""

    attaches = False

    def key(self, endpoint: Endpoint) -> str:
        return endpoint.topic.strip("/")

    def any_type_key(self, endpoint: Endpoint) -> str:
        return self.key(endpoint)

    def token(self, endpoint: Endpoint, zid: str, number: int) -> str:
        e = endpoint
        slash = chr(0xA7)  # the bridge's sign in place of /
        token = f"@/{zid}/@ros2_lv/{e.kind.value}/{self.key(e).replace('/', slash)}/{e.message.replace('/', slash)}"
        if e.kind is Kind.SERVICE:
            return token
        durability = _DDS_TRANSIENT_LOCAL if e.latched else _DDS_VOLATILE
        return f"{token}/:{_DDS_RELIABLE}:{durability}:{_DDS_KEEP_LAST},{e.depth}"

    def node_token(self, zid: str) -> str:
        return f"@/{zid}/@ros2_lv"


def gid(token: str) -> bytes:
    """(16,) identity of an endpoint, which rmw_zenoh computes from its token in the same way.

    Raises:
        ConfigError: xxhash is not installed.
    """
    try:
        import xxhash
    except ImportError as e:
        raise ConfigError("zenoh.wire: found no xxhash, expected it for rmw_zenoh; pip install 'ceilvo[ros2]'") from e
    return int(xxhash.xxh3_128_intdigest(token.encode())).to_bytes(_GID_BYTES, "little")


def attachment(sequence: int, unix_ns: int, identity: bytes) -> bytes:
    """(33,) what every sample of rmw_zenoh carries; one without it is dropped."""
    return struct.pack("<qqB", sequence, unix_ns, len(identity)) + identity


def _mangled(name: str) -> str:
    return name.replace("/", "%")
