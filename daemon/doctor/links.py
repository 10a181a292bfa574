"""The doctor's checks of what the daemon talks to: the base and Zenoh."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

from ceilvo.config import Config
from ceilvo.config.zenoh_names import endpoint_address
from ceilvo.daemon.doctor.findings import Finding, Patient, fine, note, wrong
from ceilvo.drivers.base.modbus import ModbusBase
from ceilvo.drivers.bus.zenoh_session import session_config
from ceilvo.errors import BaseLinkError, BusError, ConfigError

_CONNECT_S = 1.0
"""How long an endpoint may take to answer; chosen: a local network takes milliseconds."""


def base(p: Patient) -> Iterator[Finding]:
    """The port is there, permitted and free, and somebody answers on it in our protocol version."""
    if p.config is None:
        return
    cfg = p.config.base
    if not cfg.enabled:
        yield note("base", "base.enabled: false, so no base is told the pose")
        return
    port = Path(cfg.port)
    if not port.exists():
        there = sorted(str(x) for x in p.machine.path("/dev/serial/by-id").glob("*"))
        found = f"present: {', '.join(there)}" if there else "no serial adapter is plugged in"
        yield wrong("base", f"base.port {port}: no such device; {found}")
        return
    if not p.machine.may_write(port.resolve()):
        group, who = p.machine.group_of(port.resolve()), p.machine.user or "you"
        yield wrong("base", f"base.port {port}: {who} may not read and write it; 'usermod -aG {group} {who}'")
        return
    holders = p.machine.holders(str(port.resolve()))
    if holders:
        text = f"base.port {port}: in use by {', '.join(holders)}"
        if p.holds_all(holders):
            yield fine("base", f"{text}, the daemon; its status tells how it goes")
        else:
            yield wrong("base", f"{text}: only one can have it; is a daemon running already? end the other program")
        return
    if p.running:
        yield fine("base", f"base.port {port}: not asked, because the daemon (pid {p.running}) speaks with it")
        return
    yield _ask_base(p.config)


def _ask_base(config: Config) -> Finding:
    link = ModbusBase(config.base)
    try:
        link.open()
        status = link.read_status()
    except BaseLinkError as e:
        return wrong("base", str(e))
    finally:
        link.close()
    state = [name for name, on in (("e-stop", status.e_stop), ("fault", status.fault)) if on]
    return fine(
        "base",
        f"{config.base.port}: unit {config.base.unit_id} answers in protocol version {status.version}"
        + (f", it reports {' and '.join(state)}" if state else ""),
    )


def bus(p: Patient) -> Iterator[Finding]:
    """The settings are possible, ports to listen on are free, routers to connect to answer."""
    if p.config is None:
        return
    cfg = p.config.zenoh
    if not cfg.enabled:
        yield note("zenoh", "zenoh.enabled: false, so nobody hears the pose but the base")
        return
    try:
        session_config(cfg)
    except (BusError, ConfigError) as e:
        yield wrong("zenoh", str(e))
        return
    if cfg.config_file:
        yield fine("zenoh", f"{cfg.config_file} can be read; its endpoints are not tried here")
        return
    problems = [*_listening(p), *_connecting(p)]
    yield from problems
    if not problems:
        peers = f", reaches {', '.join(cfg.connect)}" if cfg.connect else ""
        yield fine("zenoh", f"{cfg.mode}, can listen on {', '.join(cfg.listen) or 'nothing'}{peers}")


def _listening(p: Patient) -> Iterator[Finding]:
    assert p.config is not None
    for end in p.config.zenoh.listen:
        address = endpoint_address(end)
        if address is None or address[1] == 0 or p.running:
            continue
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as s:
            s.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                s.bind(address)
            except OSError as e:
                yield wrong("zenoh", f"zenoh.listen: {end} cannot be used: {e.strerror}; take another port or address")


def _connecting(p: Patient) -> Iterator[Finding]:
    assert p.config is not None
    for end in p.config.zenoh.connect:
        address = endpoint_address(end)
        if address is None:
            continue
        try:
            socket.create_connection(address, _CONNECT_S).close()
        except OSError as e:
            why = e.strerror or str(e)
            yield wrong("zenoh", f"zenoh.connect: {end} does not answer: {why}; start the router or correct it")
