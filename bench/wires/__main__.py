"""What other people's programs get from the daemon, and what it costs: `python -m ceilvo.bench.wires --seconds 30`."""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from ceilvo.bench.soak.parts import free_port
from ceilvo.bench.wires.router import Router, as_ros
from ceilvo.drivers.bus import messages

_BACK_S = 5.0
"""Bar of a router that comes back."""
_RUNS = 10
_LOOKED_AT = ("ceilvo/robot1/pose", "ceilvo/robot1/odom", "ceilvo/robot1/landmarks", "robot1/tf")
_ROS = (
    "*/tf/**",
    "*/odom/**",
    "*/landmarks/**",
    "*/image/**",
    "*/camera_info/**",
    "tf",
    "pose",
    "odom",
    "image/compressed",
)


class _Program:
    """A module of this bench in a process of its own."""

    def __init__(self, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def end(self, said: str = "") -> dict[str, Any]:
        out, _ = self.process.communicate(said)
        return dict(json.loads(out.splitlines()[-1]))


def decoded(seconds: float, rate_hz: float) -> None:
    """A simulated drive, read by zenoh-ros2-sdk in another process and as JSON, both behind a router."""
    told: dict[int, dict[str, Any]] = {}

    def take(sample: zenoh.Sample) -> None:
        fields = messages.decode(sample.payload.to_bytes(), "pose")
        told[fields["stamp_unix_ns"]] = fields

    with (
        Router(free_port()) as router,
        tempfile.TemporaryDirectory() as folder,
        zenoh.open(as_ros(router.end)) as session,
    ):
        session.declare_subscriber("ceilvo/robot1/pose", take)
        words = ["run", "--simulate", "--summary", str(Path(folder) / "s.json")]
        for setting in (
            f"service.state_dir={folder}",
            f"camera.rate_hz={rate_hz:g}",
            f"zenoh.connect=[{router.end}]",
            "zenoh.multicast=false",
            "zenoh.wire=[json,rmw_zenoh,ros2dds]",
            "base.enabled=false",
        ):
            words += ["--set", setting]
        daemon = subprocess.Popen(
            [sys.executable, "-m", "ceilvo.daemon.cli", *words], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            while not told:
                threading.Event().wait(0.05)
            reader = _Program("ceilvo.bench.wires.reader", str(router.port))
            reader.line()
            threading.Event().wait(seconds)
            heard = reader.end("end\n")
        finally:
            daemon.terminate()
            daemon.wait()
    poses = {int(p[0]): p for p in heard["poses"]}
    first, last = min(poses), max(poses)
    expected = [t for t in told if first <= t <= last]
    off = [
        np.abs(np.subtract(poses[t][1:4], [told[t][k] for k in ("x_m", "y_m", "theta_rad")])).max()
        for t in expected
        if t in poses
    ]
    share = 100.0 * sum(t in poses for t in expected) / len(expected)
    span_s = 1e-9 * (last - first)
    print(
        f"zenoh-ros2-sdk: {len(poses)} poses in {span_s:.1f} s, {len(poses) / span_s:.1f} Hz; {share:.2f} % of JSON's"
    )
    print(f"                largest difference {max(off):.1e} m, rad; {len(heard['warnings'])} warnings")


def cost(seconds: float) -> None:
    """Processor time of the wires alone at 30 Hz, json and all of them after one another, three times."""
    shares: dict[str, list[float]] = {"json": [], "all": []}
    with Router(free_port()) as router:
        for _ in range(3):
            for mode, found in shares.items():
                speaker = _Program("ceilvo.bench.wires.speaker", str(router.port), mode, str(seconds / 3.0))
                if speaker.line() != "ready":
                    raise SystemExit("wires: the speaker did not start")
                with zenoh.open(as_ros(router.end)) as session:
                    for key in (*_LOOKED_AT, *_ROS):
                        session.declare_subscriber(key, lambda sample: None)
                    got = speaker.end()
                found.append(100.0 * got["cpu_s"] / got["seconds"])
    json_only, everything = (float(np.median(shares[m])) for m in ("json", "all"))
    for mode, found in shares.items():
        print(f"cpu {mode:5}       {', '.join(f'{v:.1f}' for v in found)} % of a core")
    print(
        f"added           {everything - json_only:.1f} % of a core by rmw_zenoh, ros2dds, <robot>/tf, DDS (bar: 10 %)"
    )


def routers() -> None:
    """A router killed and another started on its port: until the next pose of a new peer, a new client."""
    slowest, wrong = 0.0, 0
    for run in range(_RUNS):
        port = free_port()
        router = Router(port)
        speaker = _Program("ceilvo.bench.wires.speaker", str(port), "json", "12")
        speaker.line()
        threading.Event().wait(1.0)
        router.kill()
        threading.Event().wait(0.5)
        router = Router(port)
        begun = time.monotonic()
        changes: dict[str, object] = {"mode": "client", "listen/endpoints": []} if run % 2 else {}
        seqs: list[int] = []
        first = threading.Event()

        def take(sample: zenoh.Sample, seqs: list[int] = seqs, first: threading.Event = first) -> None:
            seqs.append(messages.decode_pose(sample.payload.to_bytes()).seq)
            first.set()

        with zenoh.open(as_ros(router.end, **changes)) as session:
            session.declare_subscriber("ceilvo/robot1/pose", take)
            first.wait(2.0 * _BACK_S)
            slowest = max(slowest, time.monotonic() - begun)
            threading.Event().wait(0.5)
        wrong += sum(b != a + 1 for a, b in itertools.pairwise(seqs))
        speaker.process.kill()
        speaker.process.communicate()
        router.kill()
    verdict = "all" if slowest < _BACK_S else "NOT all"
    print(
        f"router killed   {verdict} of {_RUNS} back in {_BACK_S:g} s, slowest {slowest:.2f} s; {wrong} gaps or repeats"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, epilog="example: python -m ceilvo.bench.wires --seconds 30")
    parser.add_argument(
        "--seconds", type=float, default=30.0, help="of the drive, and of the measurement (default: 30)"
    )
    parser.add_argument("--rate-hz", type=float, default=30.0, help="of the drive's camera (default: 30)")
    parser.add_argument("--only", choices=("decoded", "cost", "routers"), help="one of the three")
    options = parser.parse_args()
    if options.only in (None, "decoded"):
        decoded(options.seconds, options.rate_hz)
    if options.only in (None, "cost"):
        cost(options.seconds)
    if options.only in (None, "routers"):
        routers()


if __name__ == "__main__":
    main()
