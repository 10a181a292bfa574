"""TLS and access control of Zenoh with real certificates, limits on what is received, loopback by default."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from patience import until

from ceilvo import config
from ceilvo.calibration import Calibration
from ceilvo.drivers.bus import commands
from ceilvo.drivers.bus.requests import Handlers
from ceilvo.drivers.bus.zenoh_bus import ZenohBus
from ceilvo.drivers.bus.zenoh_session import session_config
from ceilvo.drivers.ports import Topic
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Landmarks

OPENSSL = shutil.which("openssl") or ""
STEM = "ceilvo/robot1"
POSE = b'{"x_m": 1.0, "y_m": 2.0, "theta_rad": 0.5}'


def openssl(folder: Path, *args: str) -> None:
    done = subprocess.run([OPENSSL, *args], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def certificate(folder: Path, name: str, ca: str = "ca") -> None:
    """NAME.key and NAME.pem for the common name NAME, signed by a CA of the folder."""
    (folder / f"{name}.ext").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1\n")
    openssl(folder, "req", "-newkey", "rsa:2048", "-nodes", "-keyout", f"{name}.key", "-out", f"{name}.csr",
            "-subj", f"/CN={name}")  # fmt: skip
    openssl(folder, "x509", "-req", "-in", f"{name}.csr", "-CA", f"{ca}.pem", "-CAkey", f"{ca}.key", "-CAcreateserial",
            "-days", "2", "-extfile", f"{name}.ext", "-out", f"{name}.pem")  # fmt: skip


def authority(folder: Path, name: str) -> None:
    openssl(folder, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", f"{name}.key", "-out", f"{name}.pem",
            "-days", "2", "-subj", f"/CN={name}")  # fmt: skip


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if not OPENSSL:
        pytest.skip("openssl is not installed")
    folder = tmp_path_factory.mktemp("keys")
    authority(folder, "ca")
    authority(folder, "strangers")
    for name in ("robot1", "operator", "display"):
        certificate(folder, name)
    certificate(folder, "stranger", ca="strangers")
    return folder


class Daemon:
    """The bus as the daemon opens it, from a configuration file as docs/security.md shows it."""

    def __init__(self, keys: Path, folder: Path) -> None:
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            self.port = int(s.getsockname()[1])
        text = documented_config().replace("/etc/ceilvo/", f"{keys}/").replace("7447", str(self.port))
        file = folder / "zenoh.json5"
        file.write_text(text)
        self.asked: list[commands.Command] = []

        def do(command: commands.Command) -> dict[str, object]:
            self.asked.append(command)
            return {"did": "it"}

        none = Landmarks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2, 2)), *(np.zeros(0, np.int64),) * 2)
        calibration: Calibration = simulated_calibration()
        handlers = Handlers(lambda: none, lambda: calibration, config.Config, do, do, do, do)
        self.bus = ZenohBus(replace(config.Zenoh(), config_file=str(file)), "robot1", handlers)
        self.bus.open()


def documented_config() -> str:
    """The robot's configuration of docs/security.md."""
    text = (Path(__file__).parents[2] / "docs" / "security.md").read_text()
    return text.split("```json5\n", 1)[1].split("```", 1)[0]


@pytest.fixture(scope="module")
def daemon(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    made = Daemon(keys, tmp_path_factory.mktemp("zenoh"))
    yield made
    made.bus.close()


@dataclass
class Client:
    session: zenoh.Session

    def ask(self, key: str, payload: bytes = b"", timeout: float = 3.0) -> list[bool]:
        return [r.ok is not None for r in self.session.get(key, payload=payload, timeout=timeout)]


def client(daemon: Daemon, keys: Path, name: str | None, protocol: str = "tls") -> Client:
    """A client with a certificate of ours, or none. Raises zenoh.ZError when it is not let in."""
    conf = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": [f"{protocol}/localhost:{daemon.port}"],
        "connect/timeout_ms": 2000,
        "scouting/multicast/enabled": False,
        "transport/link/tls/root_ca_certificate": str(keys / "ca.pem"),
    }
    if name is not None:
        settings |= {
            "transport/link/tls/enable_mtls": True,
            "transport/link/tls/connect_certificate": str(keys / f"{name}.pem"),
            "transport/link/tls/connect_private_key": str(keys / f"{name}.key"),
        }
    for key, value in settings.items():
        conf.insert_json5(key, json.dumps(value))
    return Client(zenoh.open(conf))


def let_in(daemon: Daemon, keys: Path, name: str | None, protocol: str = "tls") -> bool:
    """Whether anything of the daemon can be reached. TLS 1.3 lets a client believe it is in before it is refused."""
    try:
        c = client(daemon, keys, name, protocol)
    except zenoh.ZError:
        return False
    try:
        return bool(c.ask(f"{STEM}/map") or c.ask(f"{STEM}/map"))
    finally:
        c.session.close()  # type: ignore[no-untyped-call]


def eventually(c: Client, key: str, payload: bytes = b"") -> list[bool]:
    """The first answer; declarations take a moment to arrive."""
    answers: list[bool] = []

    def answered() -> bool:
        answers[:] = c.ask(key, payload)
        return bool(answers)

    until(answered, f"an answer from {key}")
    return answers


def test_an_operator_reads_and_commands(daemon: Daemon, keys: Path) -> None:
    c = client(daemon, keys, "operator")
    got = threading.Event()
    c.session.declare_subscriber(f"{STEM}/pose", lambda _: got.set())
    assert eventually(c, f"{STEM}/map") == [True]
    before = len(daemon.asked)
    assert eventually(c, f"{STEM}/cmd/initial_pose", POSE) == [True]
    assert len(daemon.asked) == before + 1
    until(lambda: daemon.bus.put(Topic.POSE, b"{}") or got.wait(0.05), "a pose")
    c.session.close()  # type: ignore[no-untyped-call]


def test_a_display_reads_and_may_not_command(daemon: Daemon, keys: Path) -> None:
    """Its certificate is good, and is not an operator's."""
    c = client(daemon, keys, "display")
    got = threading.Event()
    c.session.declare_subscriber(f"{STEM}/pose", lambda _: got.set())
    until(lambda: daemon.bus.put(Topic.POSE, b"{}") or got.wait(0.05), "a pose")
    assert eventually(c, f"{STEM}/map") == [True]
    before = len(daemon.asked)
    for command in commands.COMMANDS:
        assert c.ask(f"{STEM}/cmd/{command}", POSE if command == "initial_pose" else b"", timeout=1.0) == []
    assert c.ask(f"{STEM}/cmd/*", b"", timeout=1.0) == []
    assert c.ask(f"{STEM}/**", b"", timeout=1.0) == []
    assert len(daemon.asked) == before
    c.session.close()  # type: ignore[no-untyped-call]


def test_nobody_else_may_speak_for_the_robot(daemon: Daemon, keys: Path) -> None:
    """A false pose put by a display reaches no operator."""
    liar, listener = client(daemon, keys, "display"), client(daemon, keys, "operator")
    heard: list[bytes] = []
    listener.session.declare_subscriber(f"{STEM}/pose", lambda s: heard.append(s.payload.to_bytes()))

    def both_put() -> bool:
        liar.session.put(f"{STEM}/pose", b"false")
        daemon.bus.put(Topic.POSE, b"true")
        return b"true" in heard

    until(both_put, "a pose")
    assert b"false" not in heard
    for c in (liar, listener):
        c.session.close()  # type: ignore[no-untyped-call]


def test_a_client_without_a_certificate_is_refused(daemon: Daemon, keys: Path) -> None:
    assert let_in(daemon, keys, "operator")
    assert not let_in(daemon, keys, None)


def test_a_certificate_of_another_authority_is_refused(daemon: Daemon, keys: Path) -> None:
    assert not let_in(daemon, keys, "stranger")


def test_without_tls_nobody_gets_in(daemon: Daemon, keys: Path) -> None:
    assert not let_in(daemon, keys, None, protocol="tcp")


def test_what_is_far_too_large_is_dropped_before_it_is_put_together() -> None:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = int(s.getsockname()[1])
    conf = session_config(replace(config.Zenoh(), listen=(f"tcp/127.0.0.1:{port}",), multicast=False))
    sizes: list[int] = []

    def note(query: zenoh.Query) -> None:
        with query:
            sizes.append(len(query.payload or b""))
            query.reply("a/cmd", b"ok")

    with zenoh.open(conf) as daemon, zenoh.open(peer_of(port)) as other:
        queryable = daemon.declare_queryable("a/cmd", note)
        c = Client(other)
        assert eventually(c, "a/cmd", b"x") == [True]
        assert c.ask("a/cmd", bytes(60_000)) == [True]
        assert True not in c.ask("a/cmd", bytes(100_000), timeout=1.0)
        assert True not in c.ask("a/cmd", bytes(5_000_000), timeout=1.0)
        assert max(sizes) == 60_000
        assert eventually(c, "a/cmd", b"x") == [True], "and the connection is as good as before"
        queryable.undeclare()  # type: ignore[no-untyped-call]


def peer_of(port: int) -> zenoh.Config:
    conf = zenoh.Config()
    conf.insert_json5("scouting/multicast/enabled", "false")
    conf.insert_json5("listen/endpoints", "[]")
    conf.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    return conf


def test_by_default_only_this_computer_can_reach_the_daemon() -> None:
    """Asked of the kernel, not of the configuration: every listening TCP socket of a session is on loopback."""
    before = listening()
    with zenoh.open(session_config(config.Zenoh())):
        new = listening() - before
    assert new
    assert all(address.startswith(("0100007F:", "00000000000000000000000001000000:")) for address in new), new


def listening() -> set[str]:
    """Local addresses of listening TCP sockets as the kernel writes them."""
    out = set()
    for name in ("tcp", "tcp6"):
        path = Path(f"/proc/self/net/{name}")
        for line in path.read_text().splitlines()[1:] if path.exists() else []:
            fields = line.split()
            if fields[3] == "0A":
                out.add(fields[1])
    return out
