"""A ROS 2 node on a Zenoh session: publishers, subscribers and services as one naming writes them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import zenoh

from ceilvo.drivers.bus.zenoh_session import zenoh_reason
from ceilvo.drivers.ros2.endpoints import Endpoint, Endpoints
from ceilvo.drivers.ros2.intake import MOST_BYTES, Intake
from ceilvo.drivers.ros2.naming import Naming, attachment, gid

log = logging.getLogger(__name__)

_CDR = zenoh.Encoding("application/cdr")


class Transport(Protocol):
    """A wire for messages in CDR. Thread-safe; nothing here blocks or raises once it is open."""

    def open(self, intake: Intake) -> None:
        """Raises BusError when it cannot be used."""

    def put(self, endpoint: Endpoint, payload: bytes, unix_ns: int) -> bool:
        """False where it was not sent."""

    def wanted(self, endpoint: Endpoint) -> bool:
        """Whether somebody subscribes."""

    def close(self) -> None: ...


@dataclass
class _Publisher:
    put: Callable[..., None]
    matching: Callable[[], bool]
    identity: bytes = b""
    sequence: int = 0


class ZenohTransport:
    """One naming on a session that somebody else opens and closes: see declare()."""

    def __init__(self, naming: Naming, endpoints: Endpoints, latched: Callable[[], dict[Endpoint, bytes]]) -> None:
        """`latched` gives what is said once, as soon as there is a session."""
        self._naming, self._endpoints, self._latched = naming, endpoints, latched
        self._publishers: dict[Endpoint, _Publisher] = {}
        self._held: list[Any] = []
        self._lock = threading.Lock()
        self._intake: Intake | None = None

    def open(self, intake: Intake) -> None:
        self._intake = intake

    def declare(self, session: zenoh.Session) -> None:
        """On the session, in the thread that opened it."""
        e, zid = self._endpoints, str(session.info.zid())
        tokens = session.liveliness()
        for number, endpoint in enumerate((*e.published, e.initial_pose, *e.served), 1):
            token = self._naming.token(endpoint, zid, number)
            if endpoint in e.published:
                self._publishers[endpoint] = self._publisher(session, endpoint, token)
            elif endpoint in e.served:
                self._held.append(self._service(session, endpoint))
            else:
                self._held.append(self._subscriber(session, endpoint))
            self._held.append(tokens.declare_token(token))
        self._held.append(tokens.declare_token(self._naming.node_token(zid)))
        for endpoint, payload in self._latched().items():
            self.put(endpoint, payload, time.time_ns())

    def put(self, endpoint: Endpoint, payload: bytes, unix_ns: int) -> bool:
        publisher = self._publishers.get(endpoint)
        if publisher is None:
            return False
        try:
            with self._lock:  # numbers in the order of the samples
                publisher.sequence += 1
                extra = attachment(publisher.sequence, unix_ns, publisher.identity) if publisher.identity else None
                publisher.put(payload, attachment=extra)
        except zenoh.ZError as e:
            log.debug("%s: %s", endpoint.topic, zenoh_reason(e))
            return False
        return True

    def wanted(self, endpoint: Endpoint) -> bool:
        publisher = self._publishers.get(endpoint)
        return publisher is not None and publisher.matching()

    def close(self) -> None:
        self._publishers.clear()

    def _publisher(self, session: zenoh.Session, endpoint: Endpoint, token: str) -> _Publisher:
        options: dict[str, Any] = {
            "encoding": _CDR,
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": zenoh.Priority.DATA_LOW
            if endpoint in self._endpoints.shown
            else zenoh.Priority.INTERACTIVE_HIGH,
            "allowed_destination": zenoh.Locality.REMOTE,
        }
        key = self._naming.key(endpoint)
        identity = gid(token) if self._naming.attaches else b""
        if endpoint.latched:
            cache = zenoh.ext.CacheConfig(max_samples=endpoint.depth)
            latched = zenoh.ext.declare_advanced_publisher(
                session, key, cache=cache, publisher_detection=True, **options
            )
            return _Publisher(latched.put, lambda: True, identity)
        plain = session.declare_publisher(key, **options)
        status: Any = plain  # the stubs call matching_status a bool
        return _Publisher(plain.put, lambda: bool(status.matching_status.matching), identity)

    def _subscriber(self, session: zenoh.Session, endpoint: Endpoint) -> Any:
        own = self._naming.key(endpoint)

        def heard(sample: zenoh.Sample) -> None:
            if self._intake is not None:
                key = str(sample.key_expr)
                self._intake.initial_pose(key, _start_of(sample.payload), key == own)

        return session.declare_subscriber(
            self._naming.any_type_key(endpoint), heard, allowed_origin=zenoh.Locality.REMOTE
        )

    def _service(self, session: zenoh.Session, endpoint: Endpoint) -> Any:
        key = self._naming.key(endpoint)

        def respond(query: zenoh.Query) -> None:
            with query:
                if self._intake is None:
                    return
                payload = _start_of(query.payload)
                answer = self._intake.call(endpoint, key, payload, exact=str(query.key_expr) == key)
                try:
                    if answer is None:
                        query.reply_err(b"refused: the daemon's log says why")
                    else:  # a client knows the answer to its question by what it attached
                        query.reply(key, answer, encoding=_CDR, attachment=query.attachment)
                except zenoh.ZError as e:
                    log.debug("%s: %s", key, zenoh_reason(e))

        return session.declare_queryable(key, respond, complete=True)


class FleetTransport:
    """The one key that Open-RMF's free_fleet reads: <robot>/tf, CDR without more."""

    def __init__(self, endpoints: Endpoints) -> None:
        self._endpoint = endpoints.fleet
        self._publisher: zenoh.Publisher | None = None

    def open(self, intake: Intake) -> None:
        """Nothing is heard there."""

    def declare(self, session: zenoh.Session) -> None:
        self._publisher = session.declare_publisher(
            self._endpoint.topic.strip("/"), encoding=_CDR, congestion_control=zenoh.CongestionControl.DROP
        )

    def put(self, endpoint: Endpoint, payload: bytes, unix_ns: int) -> bool:
        publisher = self._publisher
        if publisher is None or endpoint != self._endpoint:
            return False
        try:
            publisher.put(payload)
        except zenoh.ZError as e:
            log.debug("%s: %s", endpoint.topic, zenoh_reason(e))
            return False
        return True

    def wanted(self, endpoint: Endpoint) -> bool:
        return endpoint == self._endpoint and self._publisher is not None

    def close(self) -> None:
        self._publisher = None


def _start_of(payload: zenoh.ZBytes | None) -> bytes:
    """In place of what is too large something else that is too large, without copying it."""
    if payload is None:
        return b""
    return payload.to_bytes() if len(payload) <= MOST_BYTES else bytes(MOST_BYTES + 1)
