"""Robots that lie, each in a way of its own; every one must be refused, or count for nothing."""

from __future__ import annotations

import secrets
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import zstandard

from ceilvo.daemon.fleet.keys import Signer
from ceilvo.daemon.fleet.offers import MOST_ROWS, Measured, Offer, Signed, measured, signed
from ceilvo.daemon.fleet.wire import MOST_BYTES, WireError
from ceilvo.types import Landmarks

SIGMA_M = 0.003
"""That they claim."""
COPIES = 40
"""Offers of the one that sends too many, in a round."""


@dataclass
class Liar:
    """What it needs for its lies.

    Attributes:
        known: the fleet's map, which it may read.
        heard: offers of others as they went over the wire.
        boast: whether it claims to be surer than anybody.
    """

    service: str
    robot: str
    signer: Signer
    known: Landmarks
    version: int
    axis_rad: float
    rng: np.random.Generator
    heard: list[bytes]
    seq: int = 0

    def view(self, count: int = 300) -> Landmarks:
        """Some of the fleet's landmarks around a place."""
        at = self.known.xy_map_m[self.rng.integers(len(self.known))]
        near = np.argsort(np.hypot(*(self.known.xy_map_m - at).T))[:count]
        return self.known.of(np.sort(near))

    def rows(self, m: Landmarks, sigma_m: float = SIGMA_M) -> Measured:
        n = np.full(len(m), 20)
        cov = np.tile(sigma_m**2 * np.eye(2), (len(m), 1, 1))
        return measured(m.ids, m.xy_map_m, cov, m.crossing_type, n, n)

    def offer(self, rows: Measured, signer: Signer | None = None) -> bytes:
        self.seq += 1
        plain = Offer(self.service, "", self.robot, self.seq, self.version, self.axis_rad, "lie", 0.0, 0.0, rows)
        return signed(plain, signer or self.signer).packed()


def _moved(of: Callable[[np.ndarray], np.ndarray]) -> Callable[[Liar], list[bytes]]:
    def lies(liar: Liar) -> list[bytes]:
        m = liar.view()
        middle = m.xy_map_m.mean(axis=0)
        z = of((m.xy_map_m - middle) @ np.array([1.0, 1j]))
        return [liar.offer(liar.rows(replace(m, xy_map_m=middle + np.column_stack([z.real, z.imag]))))]

    return lies


def _not_finite(liar: Liar) -> list[bytes]:
    rows = liar.rows(liar.view())
    for name in ("xx", "xy", "yy"):
        rows[name][::7] = np.nan
    return [liar.offer(rows)]


def _huge(liar: Liar) -> list[bytes]:
    rows = liar.rows(liar.view())
    rows["x"] += 30_000.0
    return [liar.offer(rows)]


def _too_large(liar: Liar) -> list[bytes]:
    """More bytes than a message has, and few that unpack to very many."""
    bomb = zstandard.ZstdCompressor().compress(bytes(50_000_000))
    return [secrets.token_bytes(MOST_BYTES + 1000), bomb]


def _garbage(liar: Liar) -> list[bytes]:
    good = bytearray(liar.offer(liar.rows(liar.view())))
    good[liar.rng.integers(len(good))] ^= 0xFF
    return [liar.rng.bytes(int(n)) for n in liar.rng.integers(0, 2000, 10)] + [bytes(good)]


def _replayed(liar: Liar) -> list[bytes]:
    """What others sent, as it was and under its own signature."""
    some = liar.heard[-3:]
    mine = []
    for data in some:
        body = Signed.unpacked(data).body
        mine.append(Signed(liar.signer.public, Signed.unpacked(data).signature, body).packed())
    return some + mine


def _unknown(liar: Liar) -> list[bytes]:
    stranger = Signer.of(bytes([250]) * 32)
    return [liar.offer(liar.rows(liar.view()), stranger)]


def _too_many(liar: Liar) -> list[bytes]:
    m = liar.view(20)
    return [liar.offer(liar.rows(m)) for _ in range(COPIES)]


def _invented(liar: Liar) -> list[bytes]:
    """The fleet's map as it is, and landmarks that are not there; two robots tell the same ones."""
    m = liar.view(60)
    same = np.random.default_rng(99)
    fake = np.array([10.0, 20.0]) + same.uniform(-6.0, 6.0, (200, 2))
    near = liar.known.of(np.argsort(np.hypot(*(liar.known.xy_map_m - [10.0, 20.0]).T))[:60])
    cov = np.tile(SIGMA_M**2 * np.eye(2), (200, 1, 1))
    n = np.full(200, 50)
    rows = measured(-1 - np.arange(200), fake, cov, same.integers(0, 9, 200), n, n)
    return [liar.offer(np.concatenate([liar.rows(near), rows])), liar.offer(liar.rows(m))]


def _gone(liar: Liar) -> list[bytes]:
    """Landmarks that are there are told to be gone; two robots tell the same."""
    m = liar.known.of(np.argsort(np.hypot(*(liar.known.xy_map_m - [8.0, 8.0]).T))[:400])
    rows = liar.rows(m)
    rows["seen"][100:], rows["expected"][100:] = 0, 5000
    return [liar.offer(rows)]


def _crowd(liar: Liar) -> list[bytes]:
    """New landmarks without end around a known place."""
    m = liar.view(60)
    count = MOST_ROWS - len(m)
    at = m.xy_map_m.mean(axis=0) + liar.rng.uniform(-3.0, 3.0, (count, 2))
    cov, n = np.tile(SIGMA_M**2 * np.eye(2), (count, 1, 1)), np.full(count, 5)
    first = int(liar.rng.integers(2**40))
    rows = measured(-1 - first - np.arange(count), at, cov, np.full(count, 4), n, n)
    return [liar.offer(np.concatenate([liar.rows(m), rows]))]


LIES: Mapping[str, Callable[[Liar], list[bytes]]] = {
    "shifted": _moved(lambda z: z + 0.3),
    "turned": _moved(lambda z: z * np.exp(0.03j)),
    "scaled": _moved(lambda z: z * 1.02),
    "not finite": _not_finite,
    "huge": _huge,
    "too large": _too_large,
    "garbage": _garbage,
    "replayed": _replayed,
    "unknown key": _unknown,
    "too many": _too_many,
    "invented 1": _invented,
    "invented 2": _invented,
    "gone 1": _gone,
    "gone 2": _gone,
    "crowd": _crowd,
}
"""The last five pass every check of an offer and must come to nothing for want of a third one that agrees."""


def told(kind: str, liar: Liar) -> list[bytes]:
    """One round's lies, as they go over the wire; none where it cannot be made."""
    try:
        return LIES[kind](liar)
    except WireError:
        return []
