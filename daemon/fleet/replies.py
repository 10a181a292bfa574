"""What the service says of an offer, and where it is asked."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.daemon.fleet.wire import MOST_TEXT, Fields, packed
from ceilvo.errors import one_line
from ceilvo.json_values import MAX_ID

OFFER, MANIFEST, TILES, STATUS = "offer", "manifest", "tiles", "status"
"""Last words of the service's keys."""
_REPLY, _REFUSAL = "reply.1", "refusal.1"
_MOST_WAIT_S = 1e6
GONE_AGAIN = "gone"
"""Why tiles are refused: the map has none of them any more."""
UNCHECKED = "unchecked"
"""Why an offer is refused whose ground the map does not reach yet."""
REPLAYED = "replayed"
"""Why an offer is refused whose number is not above that of the key's last one."""


def service_key(prefix: str, service: str, word: str) -> str:
    """Where a service is asked. No wildcard reaches a segment that begins with @, and no robot's name does."""
    return f"{prefix}/@fleet/{service}/{word}"


@dataclass(frozen=True)
class Reply:
    """An offer is on the service's disk.

    Attributes:
        state: taken, pending or rejected (by a person).
        text: what became of it, for people.
    """

    state: str
    text: str

    def packed(self) -> bytes:
        return packed(_REPLY, {"state": self.state, "text": one_line(self.text, MOST_TEXT)})

    @staticmethod
    def unpacked(data: bytes) -> Reply:
        f = Fields(_REPLY, data)
        return Reply(f.text("state"), f.text("text"))


@dataclass(frozen=True)
class Refusal:
    """Nothing was done.

    Attributes:
        why: one word for programs and counters.
        text: one line for people.
        wait_s: after which it may be offered again; 0: never.
        last: number of the key's last offer.
    """

    why: str
    text: str
    wait_s: float = 0.0
    last: int = 0

    def packed(self) -> bytes:
        fields = {"why": self.why, "text": one_line(self.text, MOST_TEXT), "wait_s": self.wait_s, "last": self.last}
        return packed(_REFUSAL, fields)

    @staticmethod
    def unpacked(data: bytes) -> Refusal:
        f = Fields(_REFUSAL, data)
        return Refusal(f.text("why"), f.text("text"), f.number("wait_s", _MOST_WAIT_S), f.whole("last", 0, MAX_ID))
