"""The service on Zenoh: queryables that answer from what is published, and one thread for all that is written."""

from __future__ import annotations

import json
import logging
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import zenoh

from ceilvo.config import Config
from ceilvo.daemon.fleet.manifests import Request, packed_page
from ceilvo.daemon.fleet.parts import unpacked_wanted
from ceilvo.daemon.fleet.replies import GONE_AGAIN, MANIFEST, OFFER, STATUS, TILES, Refusal, service_key
from ceilvo.daemon.fleet.service.curator import Curator
from ceilvo.daemon.fleet.service.published import Published
from ceilvo.daemon.fleet.wire import MOST_BYTES, WireError
from ceilvo.drivers.bus.zenoh_session import Connection, session_config, zenoh_reason
from ceilvo.drivers.rate_limit import QuietLog

log = logging.getLogger("ceilvo.mapd")

WAITING = 500
"""Offers that wait for the writing thread; more are told to come again. Chosen: 30 MB at most."""
_TOGETHER = 64
"""Offers that go to the disk in one transaction; chosen."""
_BUSY_S = 2.0
_TICK_S = 0.5
"""Between looks for approvals and for the end; chosen."""
_LOGGED_PER_S, _LOG_BURST = 0.2, 20


@dataclass(frozen=True)
class _Waiting:
    query: zenoh.Query
    data: bytes


class Server:
    """serve() runs until `stopping` is set, by any thread."""

    def __init__(self, curator: Curator, config: Config) -> None:
        """Opens nothing.

        Raises:
            BusError: Zenoh cannot be used as configured.
        """
        self._curator, self._config = curator, config
        self.stopping = threading.Event()
        self._waiting: queue.Queue[_Waiting] = queue.Queue(WAITING)
        self._quiet = QuietLog(log, _LOGGED_PER_S, _LOG_BURST)
        self._count_lock = threading.Lock()
        self._counts = {"requests": 0, "requests_refused": 0, "bytes_in": 0, "bytes_out": 0}
        key = "zenoh.config_file" if config.zenoh.config_file else "zenoh.listen"
        self._connection = Connection(session_config(config.zenoh), key, self._declare)
        self._declared: list[object] = []

    def serve(self, say: Callable[[str], None] = lambda text: None, alive: Callable[[], None] = lambda: None) -> None:
        """Answer until stopped.

        Args:
            say: hears once that the service is ready, and then of new versions.
            alive: called often.

        Raises:
            BusError: the session cannot be opened as configured.
        """
        self._curator.tick()
        self._connection.open()
        say(self._said())
        copied = merged = time.monotonic()
        try:
            while not self.stopping.is_set():
                self._take()
                alive()
                now = time.monotonic()
                if now - merged >= self._config.mapd.merge_period_s:
                    merged = now
                    if self._curator.tick():
                        say(self._said())
                if self._curator.copy_if_due(now - copied):
                    copied = now
        finally:
            self._connection.close()

    def _said(self) -> str:
        floors = {n: self._curator.published(n) for n in self._curator.floors()}
        return ", ".join(f"{n or 'map'} version {p.manifest.version}" for n, p in floors.items() if p) or "no map yet"

    def _take(self) -> None:
        """Whatever waits, at most _TOGETHER, in one transaction."""
        try:
            batch = [self._waiting.get(timeout=min(_TICK_S, self._config.mapd.merge_period_s))]
        except queue.Empty:
            return
        while len(batch) < _TOGETHER and not self._waiting.empty():
            batch.append(self._waiting.get_nowait())
        answers = self._curator.take([w.data for w in batch])
        for waiting, answer in zip(batch, answers, strict=True):
            with waiting.query:
                self._reply(waiting.query, OFFER, answer.packed(), ok=not isinstance(answer, Refusal))

    # -- in Zenoh's threads

    def _declare(self, session: zenoh.Session) -> None:
        on: dict[str, Callable[[zenoh.Query], None]] = {
            MANIFEST: self._on_manifest,
            TILES: self._on_tiles,
            OFFER: self._on_offer,
            STATUS: self._on_status,
        }
        for word, answer in on.items():
            self._declared.append(session.declare_queryable(self._key(word), answer))
        log.info("on Zenoh as %s", self._key("*"))

    def _key(self, word: str) -> str:
        return service_key(self._config.zenoh.prefix, self._config.mapd.building, word)

    def _on_manifest(self, query: zenoh.Query) -> None:
        with query:
            try:
                request = Request.unpacked(self._payload(query))
                answer = packed_page(self._floor(request.floor).page(request))
            except WireError as e:
                self._refuse(query, MANIFEST, e)
            else:
                self._reply(query, MANIFEST, answer)

    def _on_tiles(self, query: zenoh.Query) -> None:
        with query:
            try:
                floor, wanted = unpacked_wanted(self._payload(query))
                answers = self._floor(floor).parts(wanted)
            except WireError as e:
                self._refuse(query, TILES, e)
                return
            for answer in answers:
                self._reply(query, TILES, answer)
            if not answers:
                gone = Refusal(GONE_AGAIN, "none of these tiles is on the map now; fetch its manifest", 1.0)
                self._reply(query, TILES, gone.packed(), ok=False)

    def _on_offer(self, query: zenoh.Query) -> None:
        """The writing thread answers and lets the query go."""
        try:
            self._waiting.put_nowait(_Waiting(query, self._payload(query)))
        except queue.Full:
            with query:
                busy = Refusal("busy", f"{WAITING} offers wait already; try again", _BUSY_S)
                self._reply(query, OFFER, busy.packed(), ok=False)

    def _on_status(self, query: zenoh.Query) -> None:
        with query:
            self._reply(query, STATUS, json.dumps(self.status()).encode())

    def status(self) -> dict[str, object]:
        """Versions of the floors, and counts since the start."""
        floors = {n: self._curator.published(n) for n in self._curator.floors()}
        versions = {n: p.manifest.version for n, p in floors.items() if p is not None}
        with self._count_lock:
            return {"schema": "ceilvo.mapd.1", "floors": versions, **self._counts}

    def _floor(self, name: str) -> Published:
        published = self._curator.published(name)
        if published is None:
            raise WireError(f"floor {name[:40]!r}: there is no map of it")
        return published

    def _payload(self, query: zenoh.Query) -> bytes:
        """What is too large is not copied."""
        payload = query.payload
        size = 0 if payload is None else len(payload)
        self._count(requests=1, bytes_in=size)
        return b"" if payload is None else payload.to_bytes() if size <= MOST_BYTES else bytes(MOST_BYTES + 1)

    def _refuse(self, query: zenoh.Query, word: str, error: WireError) -> None:
        self._count(requests_refused=1)
        self._quiet.warning(f"{word} refused: {error}")
        self._reply(query, word, Refusal("malformed", str(error)).packed(), ok=False)

    def _reply(self, query: zenoh.Query, word: str, data: bytes, ok: bool = True) -> None:
        self._count(bytes_out=len(data))
        try:
            if ok:
                query.reply(self._key(word), data)
            else:
                query.reply_err(data)
        except zenoh.ZError as e:
            log.debug("%s: %s", word, zenoh_reason(e))

    def _count(self, **more: int) -> None:
        with self._count_lock:
            for name, value in more.items():
                self._counts[name] += value
