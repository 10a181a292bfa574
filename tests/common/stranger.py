"""A stranger on the robot's network: a second network namespace, and what is sent from it.

Run as a program it attacks: `stranger.py HOST UDP,PORTS TCP,PORTS SECONDS OWN_ADDRESS` forges Zenoh's scouting answers,
asks for such answers, and tries to open a session. It prints how often somebody came, and how many bytes.
The bytes are those of Zenoh's protocol 9 (zenoh.io, "commons/zenoh-protocol").
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

ROBOT, STRANGER = "10.77.0.1", "10.77.0.2"
_VERSION, _HAS_LOCATORS, _HELLO, _ROUTER, _PEER = 9, 0x20, 0x02, 0, 1
_INIT_SYN = bytes([0x01, _VERSION, 0xF1]) + bytes(range(16)) + bytes([0x0A, 0xFF, 0xFF])


@dataclass(frozen=True)
class Worlds:
    """Two network namespaces on one wire; `robot` has ROBOT, `stranger` STRANGER."""

    robot: str
    stranger: str

    def command(self, namespace: str, *args: str) -> list[str]:
        return ["ip", "netns", "exec", namespace, *args]

    def ports(self, kind: str) -> str:
        """Of sockets that the robot's namespace listens on: kind u or t."""
        listed = subprocess.run(
            self.command(self.robot, "ss", f"-ln{kind}H"), capture_output=True, text=True, check=True
        ).stdout
        return ",".join(sorted({line.split()[3].rpartition(":")[2] for line in listed.splitlines()}))

    def attack(self, seconds: float) -> tuple[int, int]:
        """Connections that the robot made to the stranger, and bytes that came back to him."""
        done = subprocess.run(
            self.command(
                self.stranger, sys.executable, __file__, ROBOT, self.ports("u"), self.ports("t"), str(seconds), STRANGER
            ),
            capture_output=True,
            text=True,
            check=True,
        )
        connected, answered = done.stdout.split()
        return int(connected), int(answered)


def why_not() -> str:
    """Why namespaces cannot be made here; "" where they can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if not shutil.which("ip") or not shutil.which("ss"):
        return "iproute2 is not installed"
    return ""


@contextmanager
def worlds() -> Iterator[Worlds]:
    made = Worlds(f"robot{os.getpid()}", f"stranger{os.getpid()}")
    wires = [f"r{os.getpid()}", f"s{os.getpid()}"]
    try:
        for name in (made.robot, made.stranger):
            _ip("netns", "add", name)
            _ip("-n", name, "link", "set", "lo", "up")
        _ip("link", "add", wires[0], "type", "veth", "peer", "name", wires[1])
        for name, wire, address in zip((made.robot, made.stranger), wires, (ROBOT, STRANGER), strict=True):
            _ip("link", "set", wire, "netns", name)
            _ip("-n", name, "addr", "add", f"{address}/24", "dev", wire)
            _ip("-n", name, "link", "set", wire, "up")
        _ip("-n", made.stranger, "route", "add", "224.0.0.0/4", "dev", wires[1])
        yield made
    finally:
        for name in (made.robot, made.stranger):
            subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)


def _ip(*args: str) -> None:
    subprocess.run(["ip", *args], check=True, capture_output=True)


def _hello(locator: str, kind: int) -> bytes:
    """ "There is a router or peer, and this is where it listens."."""
    zid, end = os.urandom(16), locator.encode()
    head = bytes([_HELLO | _HAS_LOCATORS, _VERSION, (len(zid) - 1) << 4 | kind])
    return head + zid + bytes([1, len(end)]) + end


def _scout() -> bytes:
    """ "Who is there?", of routers, peers and clients."""
    return bytes([0x01, _VERSION, 0x07])


def attack(host: str, udp: list[int], tcp: list[int], seconds: float, own: str) -> tuple[int, int]:
    """As in the module's docstring; returns connections and bytes."""
    trap = socket.socket()
    trap.bind((own, 0))
    trap.listen(50)
    trap.settimeout(0.02)
    end = f"tcp/{own}:{trap.getsockname()[1]}"
    sprayer = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sprayer.bind((own, 0))
    sprayer.setblocking(False)
    connected = answered = 0
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        for to in [*((host, p) for p in udp), ("224.0.0.224", 7446)]:
            for message in (_hello(end, _PEER), _hello(end, _ROUTER), _scout(), _INIT_SYN):
                sprayer.sendto(message, to)
        answered += _received(sprayer) + sum(_session_bytes(host, port) for port in tcp)
        try:
            trap.accept()[0].close()
            connected += 1
        except TimeoutError:
            pass
    return connected, answered


def _received(sprayer: socket.socket) -> int:
    total = 0
    while True:
        try:
            total += len(sprayer.recvfrom(2048)[0])
        except (BlockingIOError, ConnectionRefusedError):
            return total


def _session_bytes(host: str, port: int) -> int:
    """Of the answer to a wish for a session."""
    try:
        with socket.create_connection((host, port), timeout=0.2) as s:
            s.sendall(len(_INIT_SYN).to_bytes(2, "little") + _INIT_SYN)
            return len(s.recv(1024))
    except OSError:
        return 0


if __name__ == "__main__":
    HOST, UDP, TCP, SECONDS, OWN = sys.argv[1:6]
    print(*attack(HOST, *([int(p) for p in ports.split(",") if p] for ports in (UDP, TCP)), float(SECONDS), OWN))
