"""What becomes of offers: into the ledger, into the map when enough agree, and out again as a new version."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo.config import Mapd
from ceilvo.daemon.fleet.offers import Offer
from ceilvo.daemon.fleet.replies import Refusal, Reply
from ceilvo.daemon.fleet.service.admission import LATER_S, OUTCOME, Admission, Admitted, misfit
from ceilvo.daemon.fleet.service.agreement import agreed
from ceilvo.daemon.fleet.service.claims import claims_of
from ceilvo.daemon.fleet.service.floors import Floor
from ceilvo.daemon.fleet.service.ledger import APPROVED, REJECTED, TAKEN, Ledger
from ceilvo.daemon.fleet.service.published import Published
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.fleet.wire import WireError
from ceilvo.daemon.map.database.copies import keep_copy, open_map
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.drivers.ports import Clock
from ceilvo.drivers.rate_limit import QuietLog
from ceilvo.errors import CeilvoError, FileFormatError, one_line

log = logging.getLogger("ceilvo.mapd")

MOST_LANDMARKS = 500_000
"""Of a floor; chosen: 5 hectares at ten a square metre."""
MOST_FLOORS = 200
COPY_S = 600.0
"""Between two last good copies of the map; chosen: one of 100,000 landmarks takes 2 s."""
_LOGGED_PER_S, _LOG_BURST = 0.2, 20
"""Refusals in the log, as in drivers/bus/requests.py."""


class Curator:
    """The service but for the bus. take() and tick() are one thread's, published() is anybody's."""

    def __init__(
        self,
        path: Path,
        config: Mapd,
        clock_s: Callable[[], float] = time.time,
        monotonic_ns: Clock = time.monotonic_ns,
    ) -> None:
        """Open the database of maps and its ledger, which are made where there are none.

        Raises:
            FileFormatError: one of them cannot be used.
        """
        self.path, self._config, self._clock_s = path, config, clock_s
        self._ledger = Ledger(ledger_of(path))
        self._floors: dict[str, Floor] = {}
        self._counts: Counter[str] = Counter()
        self._refusals = QuietLog(log, _LOGGED_PER_S, _LOG_BURST, monotonic_ns)
        self._admission = Admission(config, self._ledger, monotonic_ns)
        self._dirty: set[str] = set()
        self._merged_since_copy = True
        try:
            with open_map(path, "", create=True) as db:
                names = [n for n in db.floors if n or db.version]
            for name in names:
                self._floors[name] = Floor(path, name, self._ledger, config.tile_m)
            self._copy()
        except BaseException:
            self.close()
            raise
        self._dirty.update(self._floors)

    def close(self) -> None:
        if self._counts:
            self._say_counts()
        for floor in self._floors.values():
            floor.close()
        self._ledger.close()

    # -- what robots ask

    def floors(self) -> list[str]:
        """Names of those that there are."""
        return list(self._floors)

    def published(self, floor: str) -> Published | None:
        found = self._floors.get(floor)
        return None if found is None else found.published

    def take(self, offers: Sequence[bytes]) -> list[Reply | Refusal]:
        """Judge offers; those that are let in are on the disk when this returns."""
        keys = self._ledger.keys()
        last = {key.number: key.seq for key in keys.values()}
        maps = self._maps()
        found: list[Admitted | Refusal] = []
        batch: dict[bytes, Admitted] = {}
        for data in offers:
            who = self._admission.look(data, keys)
            if isinstance(who, Refusal):
                found.append(who)
                continue
            signed, key = who
            if signed.id in batch:
                found.append(replace(batch[signed.id], again=True))
                continue
            one = self._admission.admit(signed, key, last[key.number], maps)
            if isinstance(one, Admitted):
                batch[signed.id] = one
                last[key.number] = max(last[key.number], one.offer.seq)
            found.append(one)
        try:
            self._write([f for f in found if isinstance(f, Admitted) and not f.again])
        except FileFormatError as e:
            log.error("%s", e)
            found = [f if isinstance(f, Refusal) else Refusal("not_written", one_line(e), LATER_S) for f in found]
        return [self._answer(f) for f in found]

    def _write(self, admitted: list[Admitted]) -> None:
        if not admitted:
            return
        now_s = self._clock_s()
        for a in admitted:
            if a.state == TAKEN:
                self._begin(a.offer, now_s)
        with self._ledger.change() as db:
            for a in admitted:
                self._ledger.note(db, a.signed, a.offer, a.key, a.state, now_s)
                if a.state == TAKEN:
                    claims = claims_of(a.offer.rows, a.key.number, a.key.trusted)
                    self._ledger.add_claims(db, a.offer.floor, claims, now_s)
        for a in admitted:
            self._counts["landmarks_offered"] += len(a.offer.rows)
            self._counts["landmarks_stale"] += a.stale
            if a.state == TAKEN:
                self._dirty.add(a.offer.floor)

    def _begin(self, offer: Offer, now_s: float) -> None:
        """A floor begins with the first offer that is taken."""
        if offer.floor in self._floors and self._floors[offer.floor].stored() is not None:
            return
        if len(self._floors) >= MOST_FLOORS:
            raise FileFormatError(f"{self.path}: has {MOST_FLOORS} floors, a new one is not begun")
        floor = Floor(self.path, offer.floor, self._ledger, self._config.tile_m)
        floor.begin(offer.axis_rad, now_s)
        self._floors = {**self._floors, offer.floor: floor}

    def _answer(self, found: Admitted | Refusal) -> Reply | Refusal:
        if isinstance(found, Refusal):
            self._counts[f"refused_{found.why}"] += 1
            self._refusals.warning(f"offer refused: {found.text}")
            return found
        self._counts["offers_again" if found.again else f"offers_{found.state}"] += 1
        o, again = found.offer, ", known already" if found.again else ""
        text = f"{len(o.rows)} landmarks {OUTCOME[found.state]}{again}"
        if not found.again:
            self._refusals.info(f"offer of {one_line(found.key.name, 40)}, floor {one_line(repr(o.floor), 40)}: {text}")
        return Reply(found.state, text)

    # -- what happens now and then

    def tick(self) -> bool:
        """Take what a person approved, merge what robots agree on, publish; whether any floor has a new version."""
        self._take_approved()
        self._dirty.update(name for name, floor in self._floors.items() if floor.db.follow())
        dirty, self._dirty = self._dirty, set()
        news = [self._merge(self._floors[name]) for name in sorted(dirty)]
        if self._counts:
            self._say_counts()
        return any(news)

    def copy_if_due(self, since_s: float) -> bool:
        """Make the last good copy where so much time has gone by since the last one, and something was merged."""
        if since_s < COPY_S or not self._merged_since_copy:
            return False
        self._copy()
        self._counts["claims_expired"] += self._ledger.expire(self._clock_s())
        return True

    def _take_approved(self) -> None:
        maps = self._maps()
        for number, key_number, body in self._ledger.approved():
            key = next(k for k in self._ledger.keys().values() if k.number == key_number)
            try:
                offer = Offer.unpacked(body)
                stored = maps.get(offer.floor)
                refusal = misfit(offer, key, stored) if stored is not None and len(stored.landmarks) else 0
            except WireError as e:
                refusal = Refusal("malformed", str(e))
            if isinstance(refusal, Refusal):
                log.warning("approved offer %d rejected: %s", number, refusal.text)
                self._ledger.set_state([number], APPROVED, REJECTED)
                continue
            self._begin(offer, self._clock_s())
            with self._ledger.change() as db:
                db.execute("UPDATE offers SET state = ?, body = NULL WHERE number = ?", (TAKEN, number))
                claims = claims_of(offer.rows, key.number, alone=True)
                self._ledger.add_claims(db, offer.floor, claims, self._clock_s())
            self._counts["offers_approved"] += 1
            self._dirty.add(offer.floor)

    def _merge(self, floor: Floor) -> bool:
        stored = floor.stored()
        if stored is None:
            return False
        claims, next_id = self._ledger.claims(floor.name), self._ledger.floor(floor.name)[2]
        next_id = max(next_id, int(np.max(stored.landmarks.ids, initial=-1)) + 1)
        room = MOST_LANDMARKS - len(stored.landmarks)
        changes = agreed(stored.landmarks, claims, self._config.quorum, next_id, room)
        if changes or np.any(changes.used):
            at_s = self._clock_s()
            with self._ledger.change() as db:
                if changes:
                    self._ledger.add_merge(db, floor.name, changes.rows, changes.removed, next_id + changes.added, at_s)
                self._ledger.forget(db, floor.name, claims[changes.used])
            if changes:
                floor.apply(at_s, changes.rows, changes.removed)
                self._merged_since_copy = True
        self._counts["landmarks_confirmed"] += changes.confirmed
        self._counts["landmarks_added"] += changes.added
        self._counts["landmarks_removed"] += len(changes.removed)
        self._counts["landmarks_doubled"] += changes.doubled
        if not floor.publish():
            return False
        assert floor.published is not None
        log.info(
            "floor %r: version %d, %d landmarks in %d tiles; %d new, %d better known, %d gone",
            *(
                floor.name,
                floor.published.manifest.version,
                len(stored.landmarks) + changes.added - len(changes.removed),
            ),
            *(len(floor.published.manifest.hashes), changes.added, changes.confirmed, len(changes.removed)),
        )
        return True

    def _copy(self) -> None:
        """The last good copy of the whole file."""
        self._merged_since_copy = False
        floor = next(iter(self._floors.values()), None)
        if floor is None:
            return
        try:
            keep_copy(floor.db)
        except CeilvoError as e:
            log.error("%s", e)
            return
        for floor in self._floors.values():
            floor.is_copied()

    def _maps(self) -> dict[str, StoredMap]:
        stored = {name: floor.stored() for name, floor in self._floors.items()}
        return {name: s for name, s in stored.items() if s is not None}

    def _say_counts(self) -> None:
        try:
            self._ledger.count(self._counts)
        except FileFormatError as e:
            log.error("%s", e)
            return
        self._counts = Counter()
