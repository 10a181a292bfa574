"""What a soak puts around the daemon: a base with faults, subscribers, floods, and a look at /proc."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import zenoh

from ceilvo.drivers.bus.messages import decode_pose
from ceilvo.errors import CeilvoError
from ceilvo.sim.base import SimBase
from ceilvo.types import State

STEM = "ceilvo/robot1"


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@dataclass(frozen=True, slots=True)
class Usage:
    """Of a process at a moment: resident memory, open descriptors, threads, processor seconds so far."""

    t_s: float
    rss_bytes: int
    descriptors: int
    threads: int
    cpu_s: float


def usage(pid: int, t_s: float) -> Usage:
    """Raises OSError when the process is gone."""
    folder = Path(f"/proc/{pid}")
    fields = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    stat = (folder / "stat").read_text().rsplit(")", 1)[1].split()
    cpu_s = (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")
    rss = 1024 * int(fields["VmRSS"].split()[0])
    return Usage(t_s, rss, len(list((folder / "fd").iterdir())), int(fields["Threads"]), cpu_s)


class PoseRow(NamedTuple):
    """The part of a pose sample that is kept, and when it came (CLOCK_MONOTONIC)."""

    recv_ns: int
    stamp_ns: int
    state: State
    x_m: float
    y_m: float
    theta_rad: float
    seq: int


@dataclass
class Heard:
    """What came over Zenoh, times in ns of CLOCK_MONOTONIC."""

    poses: list[PoseRow] = field(default_factory=list)
    answered_ns: list[tuple[int, int]] = field(default_factory=list)
    health: list[tuple[int, dict[str, object]]] = field(default_factory=list)


class Listener:
    """A subscriber as an application has it, on the daemon's port."""

    def __init__(self, port: int) -> None:
        self.heard = Heard()
        self.got_pose = threading.Event()
        conf = zenoh.Config()
        for key, value in {
            "scouting/multicast/enabled": False,
            "listen/endpoints": [],
            "connect/endpoints": [f"tcp/127.0.0.1:{port}"],
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 1.5},
        }.items():
            conf.insert_json5(key, json.dumps(value))
        self.session = zenoh.open(conf)
        self._subscribers = [
            self.session.declare_subscriber(f"{STEM}/pose", self._pose),
            self.session.declare_subscriber(f"{STEM}/health", self._health),
        ]

    def _pose(self, sample: zenoh.Sample) -> None:
        recv_ns, p = time.monotonic_ns(), decode_pose(sample.payload.to_bytes())
        self.heard.poses.append(PoseRow(recv_ns, p.stamp_ns, p.state, p.x_m, p.y_m, p.theta_rad, p.seq))
        self.got_pose.set()

    def _health(self, sample: zenoh.Sample) -> None:
        body = json.loads(sample.payload.to_bytes())
        stamp_ns, counters = int(body["stamp_ns"]), body["counters"]
        age_s = counters.get("base_link_age_s")
        if age_s is not None:
            self.heard.answered_ns.append((stamp_ns, stamp_ns - round(1e9 * age_s)))
        self.heard.health.append((stamp_ns, counters))

    def close(self) -> None:
        self.session.close()  # type: ignore[no-untyped-call]


class Watcher:
    """`ceilvod watch` in a process of its own, which can be made to hang."""

    def __init__(self, port: int) -> None:
        args = ["watch", "--json", "--set", f"zenoh.listen=[tcp/127.0.0.1:{port}]", "--set", "zenoh.multicast=false"]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "ceilvo.daemon.cli", *args], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def hang(self, on: bool) -> None:
        self._process.send_signal(signal.SIGSTOP if on else signal.SIGCONT)

    def close(self) -> None:
        self._process.send_signal(signal.SIGCONT)
        self._process.terminate()
        self._process.wait(10.0)


def set_base_fault(base: SimBase, name: str) -> None:
    """Make a base ill by the name in the plan, "" = healthy again."""
    faults = base.faults
    faults.silent, faults.garbage, faults.bad_crc = name == "silent", name == "garbage", name == "bad crc"
    faults.wrong_version, faults.slow_s = name == "wrong version", 0.5 if name == "slow" else 0.0
    if name == "adapter unplugged":
        base.stop()
    else:
        base.start()
    if name == "reboot":
        base.reboot()
    elif name not in ("", "silent", "garbage", "bad crc", "wrong version", "slow", "adapter unplugged"):
        raise CeilvoError(f"soak: no such fault of the base: {name}")
