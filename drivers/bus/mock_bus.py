"""A bus without a network, for tests and for running without Zenoh: keeps what was sent, answers as the real one."""

from __future__ import annotations

import threading
from collections.abc import Callable

from ceilvo.drivers.bus.messages import robot_key
from ceilvo.drivers.bus.requests import Answer, Handlers, Requests
from ceilvo.drivers.ports import ON_DEMAND, Topic


class MockBus:
    """A ports.Publisher.

    Attributes:
        subscribed: topics that somebody is said to subscribe to; change it at any time.
        fail: set to make every put fail, as a bus that was lost.
    """

    def __init__(self, robot_name: str, handlers: Handlers, *, prefix: str = "ceilvo") -> None:
        """Raises BusError as ZenohBus does for a name that cannot be part of a key."""
        robot_key(prefix, robot_name)
        self._requests = Requests(robot_name, handlers)
        self.subscribed: set[Topic] = set()
        self.fail = False
        self._lock = threading.Lock()
        self._sent: list[tuple[Topic, bytes]] = []
        self._counts = {"samples": 0, "put_errors": 0, "unsent": 0, "offer_errors": 0, "namesakes": 0}
        self._counts.update({f"samples_{t.value}": 0 for t in Topic})
        self._open = False

    def open(self) -> None:
        self._open = True

    def put(self, topic: Topic, payload: bytes) -> None:
        with self._lock:
            if not self._open:
                self._counts["unsent"] += 1
            elif self.fail:
                self._counts["put_errors"] += 1
            else:
                self._counts["samples"] += 1
                self._counts[f"samples_{topic.value}"] += 1
                self._sent.append((topic, payload))

    def wanted(self, topic: Topic) -> bool:
        return self._open and topic in self.subscribed

    def offer(self, topic: Topic, make: Callable[[], bytes]) -> None:
        """Made at once, in the caller's thread, whatever the period."""
        if topic not in ON_DEMAND:
            raise ValueError(f"{topic.value} is not made on demand, use put()")
        if not self.wanted(topic):
            return
        try:
            payload = make()
        except Exception:
            # As in ZenohBus: counted, never passed on.
            with self._lock:
                self._counts["offer_errors"] += 1
            return
        self.put(topic, payload)

    def counters(self) -> dict[str, int]:
        with self._lock:
            counts = dict(self._counts)
        return {**counts, **self._requests.counters(), "foreign_samples": 0, "routers": 0, "peers": 0}

    def close(self) -> None:
        self._open = False

    def sent(self, topic: Topic) -> list[bytes]:
        """What was published on a topic, in order."""
        with self._lock:
            return [payload for t, payload in self._sent if t is topic]

    def ask(self, name: str, payload: bytes = b"", *, exact: bool = True) -> Answer:
        """A request as a client would send it: "map", "cmd/reset"."""
        return self._requests.answer(name, payload, exact=exact)
