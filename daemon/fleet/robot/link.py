"""A map service as a robot asks it over Zenoh."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import zenoh

from ceilvo.config import Zenoh
from ceilvo.daemon.fleet.replies import STATUS, Refusal, service_key
from ceilvo.daemon.fleet.wire import WireError
from ceilvo.drivers.bus.zenoh_session import Connection, watcher_config, zenoh_reason
from ceilvo.errors import BusError

TIMEOUT_S = 10.0
"""Until a service that does not answer is away; chosen: it may be writing a copy of 100,000 landmarks."""


_FIND_S, _FIND_AGAIN_S = 3.0, 0.1
"""A session that has just been opened takes so long at most to find the service; chosen: routers answer in .2 s."""


class AwayError(BusError):
    """The service does not answer now."""


class RefusedError(BusError):
    """The service refuses; `refusal` says why."""

    def __init__(self, refusal: Refusal) -> None:
        super().__init__(refusal.text)
        self.refusal = refusal


class Link(Protocol):
    """Whatever asks the service."""

    def ask(self, word: str, payload: bytes) -> list[bytes]:
        """All its answers.

        Raises:
            AwayError: none came.
            RefusedError: it refused.
        """
        ...


@dataclass
class ZenohLink:
    """A ports' session that is open; counts payload bytes both ways."""

    session: zenoh.Session
    prefix: str
    service: str
    timeout_s: float = TIMEOUT_S
    bytes_out: int = 0
    bytes_in: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def ask(self, word: str, payload: bytes) -> list[bytes]:
        key = service_key(self.prefix, self.service, word)
        self._count(out=len(payload))
        try:
            # Without it only the last of several answers under one key would come.
            replies = self.session.get(
                key, payload=payload, timeout=self.timeout_s, consolidation=zenoh.ConsolidationMode.NONE
            )
            found = [(r.ok is not None, (r.ok or r.err).payload.to_bytes()) for r in replies]
        except zenoh.ZError as e:
            raise AwayError(f"{key}: {zenoh_reason(e)}") from e
        self._count(into=sum(len(data) for _, data in found))
        good = [data for ok, data in found if ok]
        if good:
            return good
        if found:
            raise _refused(key, found[0][1])
        raise AwayError(f"{key}: nobody answers; is the service running, and zenoh.connect right?")

    def _count(self, out: int = 0, into: int = 0) -> None:
        with self._lock:
            self.bytes_out += out
            self.bytes_in += into


def _refused(key: str, data: bytes) -> BusError:
    try:
        return RefusedError(Refusal.unpacked(data))
    except WireError:  # Zenoh's own, such as "Timeout"
        return AwayError(f"{key}: no answer in time")


def _find(link: Link) -> None:
    """Wait until the service is known to a new session.

    Raises:
        AwayError: it does not become known.
    """
    until = time.monotonic() + _FIND_S
    while True:
        try:
            link.ask(STATUS, b"")
            return
        except AwayError:
            if time.monotonic() > until:
                raise
        time.sleep(_FIND_AGAIN_S)


@contextmanager
def linked(config: Zenoh, service: str) -> Iterator[ZenohLink]:
    """A session of its own, for as long as it is needed.

    Raises:
        AwayError: there is no session now.
        BusError: it cannot be opened as configured.
    """
    connection = Connection(watcher_config(config), "zenoh", lambda session: None)
    connection.open()
    try:
        if connection.session is None:
            raise AwayError("zenoh: no session yet; is the router of zenoh.connect there?")
        link = ZenohLink(connection.session, config.prefix, service)
        _find(link)
        yield link
    finally:
        connection.close()
