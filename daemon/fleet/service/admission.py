"""Which offers a service lets in: known keys, genuine, not twice, not too often, measured on its map."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from ceilvo.config import Mapd
from ceilvo.daemon.fleet.offers import Offer, Signed
from ceilvo.daemon.fleet.replies import REPLAYED, UNCHECKED, Refusal
from ceilvo.daemon.fleet.service.judge import FURTHEST_M, judged
from ceilvo.daemon.fleet.service.ledger import PENDING, REJECTED, TAKEN, Key, Ledger
from ceilvo.daemon.fleet.wire import WireError
from ceilvo.daemon.map.map_file import StoredMap
from ceilvo.drivers.ports import Clock
from ceilvo.drivers.rate_limit import TokenBucket
from ceilvo.errors import one_line
from ceilvo.se2 import wrap

BURST = 20
"""Offers of a key at once: a night's drive of 30,000 landmarks."""
MOST_CLAIMS = 50_000
"""Of a key, that wait for others to agree; chosen: a hall of 5,000 m2 that nobody else has seen."""
MOST_PENDING = 50
"""Offers of a key that wait for a person; chosen."""
MOST_AXIS_RAD = np.radians(2.0)
"""Between the axes of offer and map; chosen: lines tell a robot's to .1 deg."""
LATER_S = 600.0
"""After which a robot may try again where a person must have done something meanwhile."""


@dataclass(frozen=True)
class Admitted:
    """An offer that is let in.

    Attributes:
        state: what it is to be, PENDING or TAKEN; what it is already where `again`.
        again: it is in the ledger.
        stale: landmarks that it names and the map has no more.
    """

    signed: Signed
    offer: Offer
    key: Key
    state: str
    again: bool = False
    stale: int = 0


class Admission:
    """One thread at a time."""

    def __init__(self, config: Mapd, ledger: Ledger, clock: Clock = time.monotonic_ns) -> None:
        self._config, self._ledger, self._clock = config, ledger, clock
        self._allowed: dict[int, TokenBucket] = {}

    def look(self, data: bytes, keys: dict[bytes, Key]) -> tuple[Signed, Key] | Refusal:
        """Who says so, before anything of it is believed."""
        try:
            signed = Signed.unpacked(data)
        except WireError as e:
            return Refusal("malformed", str(e))
        key = keys.get(signed.public)
        name = signed.public.hex()[:16]
        if key is None or key.gone:
            what = "is not one of ours" if key is None else "was taken back"
            text = f"key {name}... {what}; 'ceilvod mapd keys --add' makes it known"
            return Refusal("unknown_key", text, LATER_S)
        if not signed.is_genuine(self._config.building):
            return Refusal("signature", f"not signed with key {name}... for {self._config.building}")
        return signed, key

    def admit(self, signed: Signed, key: Key, last: int, map_of: dict[str, StoredMap]) -> Admitted | Refusal:
        """
        Args:
            last: number of the key's last offer that was let in.
            map_of: floors that have a map.
        """
        try:
            offer = Offer.unpacked(signed.body)
        except WireError as e:
            return Refusal("malformed", f"{_name(key)}: {e}")
        if (state := self._ledger.known(signed.id)) is not None:
            return Admitted(signed, offer, key, state, again=True)
        if offer.service != self._config.building:
            return Refusal("service", f"{_name(key)}: is for {one_line(offer.service, 40)}, not for this building")
        if offer.seq <= last:
            text = f"{_name(key)}: offer {offer.seq} comes after {last}, expected a higher number"
            return Refusal(REPLAYED, text, 1.0, last)
        if not self._bucket(key).take():
            most = self._config.offers_per_hour
            return Refusal("too_many", f"{_name(key)}: more than {most:g} offers in an hour", 3600.0 / most)
        return self._by_policy(signed, offer, key) or self._by_map(signed, offer, key, map_of.get(offer.floor))

    def _by_policy(self, signed: Signed, offer: Offer, key: Key) -> Refusal | None:
        if self._config.policy == "trusted" and not key.trusted:
            text = f"{_name(key)}: its key is not trusted; 'ceilvod mapd keys --add --trusted' changes that"
            return Refusal("not_trusted", text, LATER_S)
        waiting = self._ledger.claimed_by(key.number)
        if waiting + len(offer.rows) > MOST_CLAIMS:
            text = f"{_name(key)}: {waiting} of its landmarks wait for others to agree, expected {MOST_CLAIMS} or fewer"
            return Refusal("waiting", text, LATER_S)
        if self._config.policy == "approve" and not key.trusted and self._ledger.pending_of(key.number) >= MOST_PENDING:
            return Refusal("waiting", f"{_name(key)}: {MOST_PENDING} of its offers wait for a person", LATER_S)
        return None

    def _by_map(self, signed: Signed, offer: Offer, key: Key, stored: StoredMap | None) -> Admitted | Refusal:
        person = self._config.policy == "approve" and not key.trusted
        state = PENDING if person else TAKEN
        if stored is None or not len(stored.landmarks):
            if key.trusted or person:
                return Admitted(signed, offer, key, state)
            text = (
                f"{_name(key)}: floor {one_line(repr(offer.floor), 40)} has no map yet, expected one of a trusted key"
            )
            return Refusal("no_map", text, LATER_S)
        refusal = misfit(offer, key, stored, np.inf if key.trusted or person else FURTHEST_M)
        if isinstance(refusal, Refusal):
            return refusal
        return Admitted(signed, offer, key, state, stale=refusal)

    def _bucket(self, key: Key) -> TokenBucket:
        new = TokenBucket(self._config.offers_per_hour / 3600.0, BURST, self._clock)
        return self._allowed.setdefault(key.number, new)


def misfit(offer: Offer, key: Key, stored: StoredMap, furthest_m: float = np.inf) -> Refusal | int:
    """Why an offer was not measured on a map; or how many of its landmarks are on the map no more.

    Args:
        furthest_m: from a new landmark to the next known one, where no person looks at it.
    """
    apart = float(wrap(offer.axis_rad - stored.map_axis_rad))
    if abs(apart) > MOST_AXIS_RAD:
        return Refusal("disagrees", f"{_name(key)}: its axes are {np.degrees(apart):+.1f} deg beside the map's")
    verdict = judged(offer.rows, stored.landmarks, furthest_m)
    if not verdict.problem:
        return verdict.stale
    why, wait_s = (UNCHECKED, LATER_S) if verdict.later else ("disagrees", 0.0)
    return Refusal(why, f"{_name(key)}: {verdict.problem}", wait_s)


def _name(key: Key) -> str:
    return f"robot {one_line(key.name, 40)}"


OUTCOME = {PENDING: "waits for a person", TAKEN: "taken", REJECTED: "rejected by a person", "approved": "approved"}
