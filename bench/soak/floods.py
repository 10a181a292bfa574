"""Floods against a daemon's Zenoh port, each in a process of its own that ends with SIGTERM and prints its count.

python -m ceilvo.bench.soak.floods puts tcp/127.0.0.1:7447
"""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import zenoh

from ceilvo.bench.soak.parts import STEM

_MB = 1_000_000
_SMALL_BYTES = 100  # chosen: as a command
_ANSWER_S = 1.0  # that an answer is waited for; chosen: a flood ends this much late at most
_SESSIONS = 990  # Zenoh takes 1000; the owner's are among them
_BURST_SESSIONS = 20  # opened and closed together; chosen
_READERS = 20  # subscribers that never read; chosen
_ROUTER_S = 3.0  # that the router is there, and then away; chosen: longer than a peer's retry
_END_S = 30.0  # that a flood may take to end: 990 sessions are closed
_PAUSE_S = 0.2  # of a flood that only holds what it has

Stop = threading.Event
Flood = Callable[[str, Stop], int]


def session(endpoint: str, **changes: Any) -> zenoh.Session:
    """A client at an endpoint. Raises zenoh.ZError when it is not let in within a second."""
    config = zenoh.Config()
    settings = {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "listen/endpoints": [],
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": 1000,
        "connect/exit_on_failure": True,
    }
    for key, value in (settings | changes).items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def puts(endpoint: str, stop: Stop) -> int:
    """Of 1 MB and of 100 bytes, to a key that the daemon answers, as fast as its computer takes them."""

    def put(payload: bytes) -> int:
        count = 0
        with session(endpoint) as s:
            while not stop.is_set():
                s.put(f"{STEM}/cmd/reset", payload, congestion_control=zenoh.CongestionControl.BLOCK)
                count += 1
        return count

    return _together([partial(put, bytes(n)) for n in (_MB, _SMALL_BYTES)])


def queries(endpoint: str, stop: Stop) -> int:
    """The map, every key at once, a command that is refused, and one whose argument is 1 MB, side by side."""

    def ask(key: str, payload: bytes) -> int:
        with session(endpoint) as s:
            return ask_until(stop.is_set, s, key, payload)

    kinds = (("map", b""), ("**", b""), ("cmd/initial_pose", b'{"x_m": "here"}'), ("cmd/reset", bytes(_MB)))
    return _together([partial(ask, *k) for k in kinds])


def ask_until(over: Callable[[], bool], s: zenoh.Session, key: str, payload: bytes) -> int:
    """Ask the robot as fast as answers come; returns how often."""
    asked = 0
    while not over():
        for _ in s.get(f"{STEM}/{key}", payload=payload, timeout=_ANSWER_S):
            pass
        asked += 1
    return asked


def idle_sessions(endpoint: str, stop: Stop) -> int:
    """As many as are let in, and they stay."""
    held: list[zenoh.Session] = []
    while not stop.wait(0.0 if len(held) < _SESSIONS else _PAUSE_S):
        if len(held) < _SESSIONS:
            try:
                held.append(session(endpoint))
            except zenoh.ZError:
                stop.wait(_PAUSE_S)
    for one in held:
        one.close()  # type: ignore[no-untyped-call]
    return len(held)


def passing_sessions(endpoint: str, stop: Stop) -> int:
    """Opened and closed as fast as it goes, some at a time."""
    count = 0
    while not stop.is_set():
        with contextlib.ExitStack() as some, contextlib.suppress(zenoh.ZError):
            for _ in range(_BURST_SESSIONS):
                some.enter_context(session(endpoint))
                count += 1
    return count


def deaf_readers(endpoint: str, stop: Stop) -> int:
    """Subscribers to everything in a process that the bench stops (SIGSTOP) when it says "deaf"."""
    held = [session(endpoint) for _ in range(_READERS)]
    subscribers = [s.declare_subscriber("**", lambda _: None) for s in held]
    print("deaf", flush=True)
    stop.wait()
    for one in held:
        one.close()  # type: ignore[no-untyped-call]
    return len(subscribers)


def router(endpoint: str, stop: Stop) -> int:
    """A router where the daemon looks for one, which comes and goes."""
    settings = {"mode": "router", "listen/endpoints": [endpoint], "connect/endpoints": []}
    count = 0
    while not stop.is_set():
        with contextlib.suppress(zenoh.ZError), session(endpoint, **settings):
            stop.wait(_ROUTER_S)
        count += 1
        stop.wait(_ROUTER_S)
    return count


def _together(jobs: Sequence[Callable[[], int]]) -> int:
    with ThreadPoolExecutor(len(jobs)) as pool:
        return sum(pool.map(lambda job: job(), jobs))


FLOODS: dict[str, Flood] = {
    "puts": puts,
    "queries": queries,
    "idle sessions": idle_sessions,
    "passing sessions": passing_sessions,
    "deaf readers": deaf_readers,
    "router": router,
}


class Flooder:
    """At most one flood at a time, in a process of its own."""

    def __init__(self, endpoints: Mapping[str, str]) -> None:
        """`endpoints`: where a flood strikes, by its name; "" for all others."""
        self._endpoints = endpoints
        self._process: subprocess.Popen[str] | None = None
        self._ending: list[threading.Thread] = []
        self.struck: dict[str, int] = {}

    def change(self, name: str) -> None:
        """End the flood under way, without waiting for it, and start another one; "" = none."""
        if self._process is not None:
            self._ending.append(threading.Thread(target=self._end, args=(self._process,)))
            self._ending[-1].start()
            self._process = None
        if not name:
            return
        endpoint = self._endpoints.get(name, self._endpoints[""])
        args = [sys.executable, "-m", "ceilvo.bench.soak.floods", name, endpoint]
        self._process = subprocess.Popen(args, text=True, stdout=subprocess.PIPE)
        if name == "deaf readers" and self._process.stdout is not None:
            self._process.stdout.readline()
            self._process.send_signal(signal.SIGSTOP)

    def close(self) -> None:
        """End the flood under way; `struck` is complete afterwards."""
        self.change("")
        for thread in self._ending:
            thread.join()

    def _end(self, process: subprocess.Popen[str]) -> None:
        process.send_signal(signal.SIGCONT)
        process.terminate()
        try:
            said, _ = process.communicate(timeout=_END_S)
            found = json.loads(said.splitlines()[-1])
            self.struck[found["flood"]] = self.struck.get(found["flood"], 0) + found["struck"]
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def main() -> int:
    name, endpoint = sys.argv[1:]
    stop = Stop()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    begun = time.monotonic()
    out: list[int] = []
    worker = threading.Thread(target=lambda: out.append(FLOODS[name](endpoint, stop)))
    worker.start()
    while worker.is_alive():  # a join would keep the signal from its handler
        worker.join(_PAUSE_S)
    print(json.dumps({"flood": name, "struck": sum(out), "seconds": time.monotonic() - begun}), flush=True)
    return 0 if out else 1


if __name__ == "__main__":
    sys.exit(main())
