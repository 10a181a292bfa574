"""The service as it is run, a router in front of it, and its end by kill -9, again and again."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import zenoh

from ceilvo.bench.fleet.robots import AXIS_RAD, SERVICE, key_of, session
from ceilvo.bench.fleet.world import Building
from ceilvo.daemon.fleet.replies import STATUS, service_key
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map

QUORUM = 3
SURVEY_SIGMA_M = 0.003
PATIENCE_S = 60.0
"""With a service that starts; never waited for unless something is broken."""
_POLL_S = 0.1
OFFERS_PER_HOUR = 18_000
"""Ten minutes pass in a second or two here."""


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


def router(port: int) -> zenoh.Session:
    """A Zenoh router of this process."""
    conf = zenoh.Config()
    for name, value in {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{port}"],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        conf.insert_json5(name, json.dumps(value))
    return zenoh.open(conf)


def survey(path: Path, building: Building, low_m: np.ndarray, high_m: np.ndarray, robots: int, seed: int) -> None:
    """The fleet's map as a person brought it: a part of the building; and the keys of the robots."""
    m = building.as_map(building.within(low_m, high_m), SURVEY_SIGMA_M, np.random.default_rng(seed))
    with open_map(path, "", create=True) as db:
        db.edit(MapContent.of(m, AXIS_RAD), "survey")
    with Ledger(ledger_of(path)) as ledger:
        for n in range(robots):
            ledger.add_key(key_of(n).public, f"robot{n}", False, 0.0)


@dataclass
class Service:
    """`ceilvod mapd run` in a process."""

    folder: Path
    port: int
    merge_period_s: float
    policy: str = "quorum"
    starts: int = 0
    cpu_s: float = 0.0
    _process: subprocess.Popen[bytes] | None = field(default=None)

    @property
    def path(self) -> Path:
        return self.folder / "building.db"

    def start(self) -> None:
        config = self.folder / "mapd.yaml"
        config.write_text(
            f"zenoh: {{mode: client, connect: [tcp/127.0.0.1:{self.port}], multicast: false}}\n"
            f"mapd: {{building: {SERVICE}, policy: {self.policy}, quorum: {QUORUM},"
            f" merge_period_s: {self.merge_period_s}, offers_per_hour: {OFFERS_PER_HOUR}}}\n"
        )
        command = [sys.executable, "-m", "ceilvo.daemon.cli", "mapd", "run", "--db", str(self.path)]
        command += ["--config", str(config)]
        with (self.folder / "mapd.log").open("ab") as log:
            self._process = subprocess.Popen(
                command, stdout=log, stderr=log, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"}
            )
        self.starts += 1

    def end(self, how: int = signal.SIGTERM) -> None:
        if self._process is None:
            return
        with contextlib.suppress(ProcessLookupError, OSError, ValueError):
            self.cpu_s += _cpu_s(self._process.pid)
        self._process.send_signal(how)
        self._process.wait(PATIENCE_S)
        self._process = None

    def kill(self) -> None:
        self.end(signal.SIGKILL)


def _cpu_s(pid: int) -> float:
    after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(after_name[11]) + int(after_name[12])) / os.sysconf("SC_CLK_TCK")


class Watcher:
    """Asks the service for its status."""

    def __init__(self, port: int) -> None:
        self._session = session(port)

    def status(self) -> dict[str, object] | None:
        """None while it is away."""
        for reply in self._session.get(service_key("ceilvo", SERVICE, STATUS), timeout=2.0):
            if reply.ok is not None:
                found: dict[str, object] = json.loads(reply.ok.payload.to_bytes())
                return found
        return None

    def until_up(self) -> float:
        """Seconds until it answers.

        Raises:
            TimeoutError: it does not.
        """
        began = time.monotonic()
        while self.status() is None:
            if time.monotonic() - began > PATIENCE_S:
                raise TimeoutError(f"the service does not answer within {PATIENCE_S:g} s; see its log")
            time.sleep(_POLL_S)
        return time.monotonic() - began

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]
