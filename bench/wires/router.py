"""A Zenoh router in a process of its own, as zenohd is one: `python -m ceilvo.bench.wires.router PORT`."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import threading

import zenoh


class Router:
    """Listens on loopback from the constructor's return on; killed, as by a power cut, at the end."""

    def __init__(self, port: int) -> None:
        self.port = port
        self.process = subprocess.Popen(
            [sys.executable, "-m", "ceilvo.bench.wires.router", str(port)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == b"ready\n"

    @property
    def end(self) -> str:
        return f"tcp/127.0.0.1:{self.port}"

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()
        if self.process.stdout is not None:
            self.process.stdout.close()

    def __enter__(self) -> Router:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()


def as_ros(router: str, **changes: object) -> zenoh.Config:
    """The session of a ROS 2 node (rmw_zenoh's default): a peer of the router, found by gossip only."""
    settings = {
        "mode": "peer",
        "listen/endpoints": ["tcp/127.0.0.1:0"],
        "connect/endpoints": [router],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 1000, "period_max_ms": 4000, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "scouting/gossip/autoconnect_strategy": {"peer": {"to_router": "always", "to_peer": "greater-zid"}},
        **changes,
    }
    out: zenoh.Config = zenoh.Config()
    for key, value in settings.items():
        out.insert_json5(key, json.dumps(value))
    return out


def _run(port: int) -> None:
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config):
        print("ready", flush=True)
        threading.Event().wait()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, epilog="example: python -m ceilvo.bench.wires.router 7447")
    parser.add_argument("port", type=int, help="to listen on, loopback only")
    _run(parser.parse_args().port)
