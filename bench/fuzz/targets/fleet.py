"""What robots and their map service send each other: packed messages, mutated before they are compressed and signed."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import zstandard

from ceilvo.bench.fleet.robots import AXIS_RAD, SERVICE, key_of
from ceilvo.bench.fleet.world import Building
from ceilvo.bench.fuzz.engine.target import Target, folder
from ceilvo.config import Mapd
from ceilvo.daemon.fleet.manifests import GONE, Manifest, Page, Request, advanced, packed_page, unpacked_page
from ceilvo.daemon.fleet.offers import Offer, Signed, measured
from ceilvo.daemon.fleet.parts import packed_part, packed_wanted, unpacked_part, unpacked_wanted
from ceilvo.daemon.fleet.replies import Refusal, Reply
from ceilvo.daemon.fleet.service.curator import Curator
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.fleet.tiles import MOST_TILE_BYTES, cut, hash_of, rows_of_tile
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.map.database.copies import open_map
from ceilvo.types import Landmarks


@lru_cache
def _map() -> Landmarks:
    rng = np.random.default_rng(1)
    building = Building.new((6.0, 5.0), rng)
    return building.as_map(np.arange(len(building.kind)), 0.003, rng)


@lru_cache
def _curator() -> Curator:
    path = folder() / "fleet" / "building.db"
    path.parent.mkdir(exist_ok=True)
    with open_map(path, "", create=True) as db:
        db.edit(MapContent.of(_map(), AXIS_RAD), "survey")
    with Ledger(ledger_of(path)) as ledger:
        ledger.add_key(key_of(0).public, "robot0", True, 0.0)
    return Curator(path, Mapd(building=SERVICE, offers_per_hour=1e6))


def _compressed(data: bytes) -> bytes:
    return zstandard.ZstdCompressor(level=1).compress(data)


def _plain(data: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(data)


def _offer(data: bytes) -> None:
    """The body of an offer that its robot signed, into a service that trusts it."""
    body = _compressed(data)
    signature = key_of(0).sign(b"\n".join([b"offer.1", SERVICE.encode(), body]))
    (answer,) = _curator().take([Signed(key_of(0).public, signature, body).packed()])
    assert "\n" not in answer.text
    _curator().tick()


def _request(data: bytes) -> None:
    """First byte: which; what comes to the service unsigned."""
    first, rest = data[:1], data[1:]
    published = _curator().published("")
    assert published is not None
    if first < b"\x50":
        published.page(Request.unpacked(_compressed(rest)))
    elif first < b"\xa0":
        published.parts(unpacked_wanted(_compressed(rest))[1])
    else:
        Signed.unpacked(_compressed(rest))


def _answer(data: bytes) -> None:
    """First byte: which; what comes to a robot."""
    first, rest = data[:1], _compressed(data[1:])
    if first < b"\x40":
        advanced(None, [unpacked_page(rest)])
    elif first < b"\x80":
        unpacked_part(rest, MOST_TILE_BYTES)
    elif first < b"\xc0":
        Reply.unpacked(rest)
    else:
        Refusal.unpacked(rest)


def _tile(data: bytes) -> None:
    rows_of_tile(data, (0, 0), 8)


def _offers() -> tuple[bytes, ...]:
    m, n = _map(), np.full(len(_map()), 9)
    cov = np.tile(1.6e-5 * np.eye(2), (len(m), 1, 1))
    rows = measured(m.ids, m.xy_map_m, cov, m.crossing_type, n, n)
    return (_plain(Offer(SERVICE, "", "robot0", 1, 1, AXIS_RAD, "drive", 1.0, 2.0, rows).packed()),)


def _requests() -> tuple[bytes, ...]:
    envelope = _plain(Signed(key_of(0).public, bytes(64), b"body").packed())
    wanted = packed_wanted("", [(hash_of(data), 0) for data in _tiles().values()])
    return (b"\0" + _plain(Request("", 0, GONE).packed()), b"\x60" + _plain(wanted), b"\xf0" + envelope)


def _tiles() -> dict[tuple[int, int], bytes]:
    return cut(_map(), np.zeros((len(_map()), 2)), 8)


def _answers() -> tuple[bytes, ...]:
    hashes = {place: hash_of(data) for place, data in _tiles().items()}
    manifest = Manifest("", 1, AXIS_RAD, 8, hashes)
    page = packed_page(Page(manifest, 0, manifest.root, len(hashes), 0, hashes))
    messages = (page, packed_part(GONE, 9, 0, b"part"), Reply("taken", "2").packed(), Refusal("busy", "later").packed())
    return tuple(first + _plain(m) for first, m in zip((b"\0", b"\x40", b"\x80", b"\xc0"), messages, strict=True))


TARGETS = {
    "fleet_offer": Target(_offer, _offers),
    "fleet_request": Target(_request, _requests),
    "fleet_answer": Target(_answer, _answers),
    "fleet_tile": Target(_tile, lambda: (_tiles()[(0, 0)],)),
}
