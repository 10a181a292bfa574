"""The daemon on Zenoh: publishers, queryables, commands and liveliness under `<prefix>/<robot>` (docs/zenoh.md)."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import zenoh

from ceilvo.config import Zenoh
from ceilvo.drivers.bus.command_guard import CommandGuard
from ceilvo.drivers.bus.commands import MAX_COMMAND_BYTES
from ceilvo.drivers.bus.foreign import ForeignSamples
from ceilvo.drivers.bus.messages import robot_key
from ceilvo.drivers.bus.namesake import namesake, session_token
from ceilvo.drivers.bus.requests import Handlers, Requests
from ceilvo.drivers.bus.zenoh_session import Connection, session_config, zenoh_reason
from ceilvo.drivers.ports import ON_DEMAND, Clock, Topic
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.errors import BusError, CeilvoError

log = logging.getLogger(__name__)

_UNMADE_PER_S, _UNMADE_BURST = 0.02, 1
"""Lines about messages that could not be made: at once, then one in 50 s."""
_LINK_CHECK_S = 1.0
"""Between two looks at who is connected."""
_JOIN_S = 1.0
"""That closing waits for a message in the making."""
_PRIORITY = {
    Topic.POSE: zenoh.Priority.INTERACTIVE_HIGH,
    Topic.ODOM: zenoh.Priority.INTERACTIVE_HIGH,
    Topic.PARTICLES: zenoh.Priority.DATA_LOW,
    Topic.IMAGE: zenoh.Priority.DATA_LOW,
}


Speaker = Callable[[zenoh.Session], None]


@dataclass
class _Offers:
    """Mailbox of one a topic, and when each may be filled again."""

    changed: threading.Condition = field(default_factory=threading.Condition)
    waiting: dict[Topic, Callable[[], bytes]] = field(default_factory=dict)
    next_ns: dict[Topic, int] = field(default_factory=dict)
    stopping: bool = False


class ZenohBus:
    """A ports.Publisher. Handlers are called in Zenoh's threads: see requests.Handlers."""

    def __init__(
        self,
        config: Zenoh,
        robot_name: str,
        handlers: Handlers,
        *,
        clock: Clock = time.monotonic_ns,
        speakers: Sequence[Speaker] = (),
        welcome: Sequence[str] = (),
    ) -> None:
        """Checks the configuration; opens nothing. Speakers declare their own on the session when there is one.

        Args:
            welcome: of the robot's own keys, those where others may speak.

        Raises:
            BusError: an endpoint, the prefix, the robot's name or the configuration file cannot be used.
        """
        self._config = config
        self._stem = robot_key(config.prefix, robot_name)
        self._requests = Requests(robot_name, handlers, guard=CommandGuard.of(config))
        self._clock = clock
        self._period_ns = {
            Topic.LANDMARKS: int(config.landmarks_period_s * 1e9),
            Topic.PARTICLES: int(config.particles_period_s * 1e9),
            Topic.IMAGE: int(config.image_period_s * 1e9),
        }
        key = "zenoh.config_file" if config.config_file else "zenoh.listen"
        self._connection = Connection(session_config(config), key, self._declare)
        self._publishers: dict[Topic, zenoh.Publisher] = {}
        self._speakers, self._welcome = tuple(speakers), tuple(welcome)
        self._declared: list[Any] = []
        self._foreign = ForeignSamples(clock)
        self._unmade = QuietLog(log, _UNMADE_PER_S, _UNMADE_BURST, clock)
        self._zid = ""
        self._speaks_json = "json" in config.wire
        self._count_lock = threading.Lock()
        self._counts = {"samples": 0, "put_errors": 0, "unsent": 0, "offer_errors": 0, "namesakes": 0}
        self._counts.update({f"samples_{t.value}": 0 for t in Topic})
        self._links: tuple[int, int] = (0, 0)
        self._offers = _Offers()
        self._worker = threading.Thread(target=self._run, name="zenoh-offers", daemon=True)
        self._closed = False

    @property
    def requests(self) -> Requests:
        """For speakers that are asked on keys of their own."""
        return self._requests

    def open(self) -> None:
        """See ports.Publisher. Once only.

        Raises:
            BusError: the session cannot be opened as configured, for example a port to listen on is taken.
        """
        if self._worker.ident is not None or self._closed:
            raise BusError("the bus was opened before; make a new one")
        self._connection.open()
        self._worker.start()

    def put(self, topic: Topic, payload: bytes) -> None:
        """See ports.Publisher. A subscriber that hangs loses samples and costs up to 1 ms a put."""
        publisher = self._publishers.get(topic)
        if publisher is None or self._closed:
            if self._speaks_json:
                self._count("unsent")
            return
        try:
            publisher.put(payload)
        except zenoh.ZError as e:
            self._count("put_errors")
            log.debug("%s: %s", topic.value, zenoh_reason(e))
        else:
            self._count("samples", f"samples_{topic.value}")

    def wanted(self, topic: Topic) -> bool:
        """See ports.Publisher."""
        publisher = self._publishers.get(topic)
        if publisher is None or self._closed:
            return False
        status: Any = publisher.matching_status  # Zenoh >= 1.5; a MatchingStatus, though the stubs say bool
        return bool(status.matching)

    def offer(self, topic: Topic, make: Callable[[], bytes]) -> None:
        """See ports.Publisher.

        Raises:
            ValueError: the topic is not made on demand.
        """
        if topic not in ON_DEMAND:
            raise ValueError(f"{topic.value} is not made on demand, use put()")
        if not self.wanted(topic):
            return
        now, offers = self._clock(), self._offers
        with offers.changed:
            if now < offers.next_ns.get(topic, now):
                return
            offers.next_ns[topic] = now + self._period_ns[topic]
            offers.waiting[topic] = make
            offers.changed.notify()

    def counters(self) -> dict[str, int]:
        """Samples in all and by topic, what was dropped and why, requests, and the routers and peers connected."""
        with self._count_lock:
            counts = dict(self._counts)
        routers, peers = self._connection.links()
        requests = self._requests.counters()
        return {**counts, **requests, "foreign_samples": self._foreign.count, "routers": routers, "peers": peers}

    def close(self) -> None:
        """Idempotent, never raises; at most 2 s, normally milliseconds."""
        if self._closed:
            return
        self._closed = True
        with self._offers.changed:
            self._offers.stopping = True
            self._offers.changed.notify()
        if self._worker.ident is not None:
            self._worker.join(_JOIN_S)
        self._connection.close()

    def _declare(self, session: zenoh.Session) -> None:
        for speaker in self._speakers:
            speaker(session)
        if self._speaks_json:
            for topic in Topic:
                self._publishers[topic] = self._publisher(session, topic)
            for name in Requests.NAMES:
                self._declared.append(session.declare_queryable(f"{self._stem}/{name}", self._responder(name)))
        self._declared.append(self._foreign.watch(session, f"{self._stem}/**", self._hint, self._welcome))
        self._zid = str(session.info.zid())
        self._declared.append(session.liveliness().declare_token(session_token(self._stem, self._zid)))
        # Last, so that whoever sees the robot appear can ask it.
        self._declared.append(session.liveliness().declare_token(self._stem))
        log.info("on Zenoh as %s", self._stem)

    def _publisher(self, session: zenoh.Session, topic: Topic) -> zenoh.Publisher:
        # Not "express": each sample would take one of the few batches of the queue, and a busy computer then loses
        # samples. Batching costs no latency, because a batch leaves as soon as the link is free.
        json_or_jpeg = zenoh.Encoding.IMAGE_JPEG if topic is Topic.IMAGE else zenoh.Encoding.APPLICATION_JSON
        return session.declare_publisher(
            f"{self._stem}/{topic.value}",
            encoding=json_or_jpeg,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=_PRIORITY.get(topic, zenoh.Priority.DATA),
            allowed_destination=zenoh.Locality.REMOTE,  # the daemon listens on its own keys for others
        )

    def _hint(self, key: str) -> str:
        return "a command is a query (docs/zenoh.md)" if key.startswith(f"{self._stem}/cmd/") else ""

    def _responder(self, name: str) -> Callable[[zenoh.Query], None]:
        key = f"{self._stem}/{name}"

        def respond(query: zenoh.Query) -> None:
            with query:
                payload, attachment = _start_of(query.payload), _start_of(query.attachment)
                answer = self._requests.answer(name, payload, attachment, exact=str(query.key_expr) == key)
                try:
                    if answer.ok:
                        query.reply(key, answer.payload, encoding=zenoh.Encoding.APPLICATION_JSON)
                    else:
                        query.reply_err(answer.payload, encoding=zenoh.Encoding.APPLICATION_JSON)
                except zenoh.ZError as e:
                    self._count("put_errors")
                    log.debug("%s: %s", key, zenoh_reason(e))

        return respond

    def _run(self) -> None:
        while True:
            with self._offers.changed:
                if not self._offers.waiting and not self._offers.stopping:
                    self._offers.changed.wait(_LINK_CHECK_S)
                if self._offers.stopping:
                    return
                waiting, self._offers.waiting = self._offers.waiting, {}
            for topic, make in waiting.items():
                self._make_and_put(topic, make)
            self._note_links()

    def _make_and_put(self, topic: Topic, make: Callable[[], bytes]) -> None:
        try:
            payload = make()
        except CeilvoError as e:
            self._count("offer_errors")
            self._unmade.warning(f"{topic.value} could not be made: {e}")
            return
        except Exception:
            # Pictures of the estimate must not end the estimate.
            self._count("offer_errors")
            log.exception("%s could not be made", topic.value)
            return
        self.put(topic, payload)

    def _note_links(self) -> None:
        links = self._connection.links()
        if links != self._links:
            log.info("Zenoh: %d routers, %d peers connected (were %d, %d)", *links, *self._links)
            if links[0] > self._links[0] and not self._config.allow_same_name:
                threading.Thread(target=self._look_for_namesakes, name="zenoh-namesake", daemon=True).start()
            self._links = links

    def _look_for_namesakes(self) -> None:
        """A router that comes late may bring one; at the start refuse_namesake() looks."""
        router = namesake(self._config, self._stem, self._zid)
        if router:
            self._count("namesakes")
            log.error("robot.name: another daemon behind %s has the name %s; stop one of them", router, self._stem)

    def _count(self, *names: str) -> None:
        with self._count_lock:
            for name in names:
                self._counts[name] += 1


def _start_of(payload: zenoh.ZBytes | None) -> bytes:
    """A request's payload; in place of one that is too large something else that is too large, without copying it."""
    if payload is None:
        return b""
    return payload.to_bytes() if len(payload) <= MAX_COMMAND_BYTES else bytes(MAX_COMMAND_BYTES + 1)
