"""What a robot says on Zenoh, one message after another in the caller's thread."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable, Collection, Sequence
from typing import Any

import zenoh

from ceilvo.config import Zenoh
from ceilvo.drivers.bus.messages import robot_key
from ceilvo.drivers.bus.zenoh_session import Connection, watcher_config
from ceilvo.drivers.ports import Topic

ALIVE, GONE = "alive", "gone"
"""In place of a topic: the robot's token came or went."""
_BACKLOG = 1000
"""Messages kept for a slow reader; more are dropped."""
_POLL_S = 0.1
"""How soon a stop is noticed."""
_ASK_S = 5.0
"""Longest that a question waits for its answer."""


class Feed:
    """Use as a context manager; each() and want() are for one thread, ask() for any."""

    def __init__(self, config: Zenoh, robot: str, topics: Sequence[Topic]) -> None:
        """
        Raises:
            BusError: Zenoh cannot be used as configured.
        """
        self._stem, self._topics = robot_key(config.prefix, robot), tuple(topics)
        self._inbox: queue.Queue[tuple[str, bytes]] = queue.Queue(_BACKLOG)
        self._held: list[object] = []
        self._wanted: dict[Topic, zenoh.Subscriber[Any]] = {}
        key = "zenoh.config_file" if config.config_file else "zenoh.listen"
        self._connection = Connection(watcher_config(config), key, self._declare)

    def __enter__(self) -> Feed:
        self._connection.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def each(self, stop: threading.Event, take: Callable[[str, bytes], None], idle: Callable[[], None]) -> None:
        """Give topics' names and payloads to `take` until `stop` is set; `idle` is called several times a second."""
        while not stop.is_set():
            with contextlib.suppress(queue.Empty):
                take(*self._inbox.get(timeout=_POLL_S))
            idle()

    def want(self, topics: Collection[Topic]) -> None:
        """Besides those of the beginning these and no others: what the daemon makes on demand costs it work."""
        session = self._connection.session
        if session is None:
            return
        for topic in [t for t in self._wanted if t not in topics]:
            self._wanted.pop(topic).undeclare()  # type: ignore[no-untyped-call]
        for topic in [t for t in topics if t not in self._wanted]:
            self._wanted[topic] = session.declare_subscriber(f"{self._stem}/{topic.value}", self._put_in(topic.value))

    def ask(self, name: str, payload: bytes = b"", token: bytes = b"") -> tuple[bool, bytes] | None:
        """The reply to a query or command ("calibration", "cmd/initial_pose") and whether it is good; None for none."""
        session = self._connection.session
        if session is None:
            return None
        attachment = token or None
        for reply in session.get(f"{self._stem}/{name}", payload=payload, attachment=attachment, timeout=_ASK_S):
            said = reply.ok or reply.err
            if said is not None:
                return reply.ok is not None, said.payload.to_bytes()
        return None

    def _declare(self, session: zenoh.Session) -> None:
        for topic in self._topics:
            self._held.append(session.declare_subscriber(f"{self._stem}/{topic.value}", self._put_in(topic.value)))

        def token(sample: zenoh.Sample) -> None:
            self._keep(ALIVE if sample.kind == zenoh.SampleKind.PUT else GONE, b"")

        self._held.append(session.liveliness().declare_subscriber(self._stem, token, history=True))

    def _put_in(self, name: str) -> Callable[[zenoh.Sample], None]:
        return lambda sample: self._keep(name, sample.payload.to_bytes())

    def _keep(self, name: str, payload: bytes) -> None:
        with contextlib.suppress(queue.Full):
            self._inbox.put_nowait((name, payload))
