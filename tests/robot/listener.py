"""Writes down what the robot publishes, with the time of its arrival. Knows Zenoh and JSON, not ceilvo.

listener.py ENDPOINT FILE KEY...: a JSON line for each sample: key, recv_ns (CLOCK_MONOTONIC), recv_unix_ns, body; of a
picture its first and last two bytes.
With "" as ENDPOINT the robot is found by multicast on this computer.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from pathlib import Path
from queue import SimpleQueue

import zenoh


def main() -> None:
    endpoint, path, *keys = sys.argv[1:]
    config = zenoh.Config()
    for name, value in {
        "mode": "peer",
        "connect/endpoints": [endpoint] if endpoint else [],
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 200, "period_increase_factor": 1.5},
        "listen/endpoints": [] if endpoint else ["tcp/127.0.0.1:0"],
        "scouting/multicast/enabled": not endpoint,
        "scouting/multicast/interface": "lo",
    }.items():
        config.insert_json5(name, json.dumps(value))
    samples: SimpleQueue[tuple[int, int, str, bytes]] = SimpleQueue()

    def take(sample: zenoh.Sample) -> None:
        samples.put((time.monotonic_ns(), time.time_ns(), str(sample.key_expr), sample.payload.to_bytes()))

    session = zenoh.open(config)
    subscribers = [session.declare_subscriber(key, take) for key in keys]
    with Path(path).open("w", buffering=1) as log:
        while threading.main_thread().is_alive():
            recv_ns, recv_unix_ns, name, payload = samples.get()
            body = (payload[:2] + payload[-2:]).hex() if name.endswith("/image") else json.loads(payload)
            line = {"key": name, "recv_ns": recv_ns, "recv_unix_ns": recv_unix_ns, "body": body}
            log.write(json.dumps(line) + "\n")
    for subscriber in subscribers:
        subscriber.undeclare()
    session.close()


if __name__ == "__main__":
    main()
