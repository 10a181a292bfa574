"""What Zenoh accepts as an endpoint and as a part of a key; it would itself take an impossible one and stay silent."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator

from ceilvo.config.schema import Zenoh

_STREAMS = ("tcp", "tls", "ws")
_IP_PROTOCOLS = ("tcp", "udp", "tls", "quic", "ws")
_LOCAL_PROTOCOLS = ("unixsock-stream", "unixpipe")
_OTHER_PROTOCOLS = (*_LOCAL_PROTOCOLS, "serial", "vsock")
_ENDPOINT = re.compile(r"(?P<protocol>[a-z-]+)/(?P<address>[^?#\s]+)(?P<rest>[?#]\S*)?")
_HOST_PORT = re.compile(r"(?P<host>\[[0-9a-fA-F:.%\w]+\]|[^:\s]+):(?P<port>\d{1,5})")
_LOOPBACK = re.compile(r"[a-z]+/(127\.\d+\.\d+\.\d+|\[::1\]|localhost):")
_PORT_MAX = 0xFFFF
"""Of TCP and UDP."""
_RESERVED_IN_SEGMENT = frozenset("/*$#? ")
"""Zenoh's key expressions: / parts segments; * $ # ? have a meaning in them, and blanks are refused."""


def segment_problem(value: str) -> str:
    """Why a value cannot be one segment of a key, from "found" on; "" when it can."""
    if value and value.isprintable() and not value.startswith("@") and _RESERVED_IN_SEGMENT.isdisjoint(value):
        return ""
    return (
        f"found {reprlib.repr(value) if value else 'nothing'}, expected one segment of a Zenoh key: not empty, "
        "none of / * $ # ? or blanks, no @ in front; try letters, digits, - and _"
    )


def endpoint_problems(config: Zenoh) -> Iterator[tuple[tuple[str, ...], str]]:
    """Every impossible endpoint, and a missing router: the keys that decide and why, from "found" on."""
    for key, ends, first_port in (("zenoh.listen", config.listen, 0), ("zenoh.connect", config.connect, 1)):
        for end in ends:
            expected = _expected(end, first_port)
            if expected:
                yield (key,), f"found {reprlib.repr(end)}, expected {expected}; for example tcp/192.168.0.2:7447"
    if config.mode == "client" and not (config.connect or config.multicast or config.config_file):
        yield (
            ("zenoh.connect", "zenoh.mode", "zenoh.multicast"),
            "found nothing, expected a router, which zenoh.mode: client needs when zenoh.multicast is off; "
            "name its endpoint, for example tcp/192.168.0.2:7447",
        )


def _expected(end: str, first_port: int) -> str:
    match = _ENDPOINT.fullmatch(end)
    if not match:
        return "protocol/address"
    if match["protocol"] in _OTHER_PROTOCOLS:
        return ""
    if match["protocol"] not in _IP_PROTOCOLS:
        return f"one of the protocols {', '.join(_IP_PROTOCOLS + _OTHER_PROTOCOLS)}"
    address = _HOST_PORT.fullmatch(match["address"])
    if not address or not first_port <= int(address["port"]) <= _PORT_MAX:
        return f"host:port with a port from {first_port} to {_PORT_MAX}"
    return ""


def endpoint_address(end: str) -> tuple[str, int] | None:
    """Host and port of an endpoint that a TCP connection reaches, None for the others."""
    match = _ENDPOINT.fullmatch(end)
    address = _HOST_PORT.fullmatch(match["address"]) if match and match["protocol"] in _STREAMS else None
    return None if address is None else (address["host"].strip("[]"), int(address["port"]))


def needs_network(config: Zenoh) -> bool:
    """Whether the daemon is to be reached from another computer, or to reach one; with a Zenoh file: it may."""
    ends = (*config.listen, *config.connect)
    return config.enabled and bool(config.config_file or not all(map(on_this_computer, ends)))


def on_this_computer(end: str) -> bool:
    """Whether an endpoint cannot be reached from the network."""
    return bool(_LOOPBACK.match(end)) or end.partition("/")[0] in _LOCAL_PROTOCOLS


def on_loopback(host: str) -> bool:
    """Whether a host's address is this computer's own."""
    return on_this_computer(f"tcp/[{host}]:" if ":" in host else f"tcp/{host}:")
