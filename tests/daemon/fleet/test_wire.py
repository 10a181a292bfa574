"""What comes over the wire: every message comes back as it was, and whatever else comes is one line, no more."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgpack
import numpy as np
import pytest
import zstandard
from fleet_parts import NOBODY, mapd, offer, rows_of, survey, surveyed
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.bench.fleet.robots import key_of
from ceilvo.daemon.fleet.manifests import GONE, Manifest, Page, Request, advanced, packed_page, unpacked_page
from ceilvo.daemon.fleet.offers import LEAST_SIGMA_M, Offer, Signed, signed
from ceilvo.daemon.fleet.parts import packed_part, packed_wanted, unpacked_part, unpacked_wanted
from ceilvo.daemon.fleet.replies import Refusal, Reply
from ceilvo.daemon.fleet.service.curator import Curator
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.fleet.tiles import MOST_TILE_BYTES, cut, hash_of, joined, rows_of_tile
from ceilvo.daemon.fleet.wire import MOST_BYTES, WireError

MAP = survey()
ROWS = rows_of(MAP.of(np.arange(200)))
TILES = cut(MAP, np.zeros((len(MAP), 2)), 8)
HASHES = {place: hash_of(data) for place, data in TILES.items()}
MANIFEST = Manifest("", 7, 0.25, 8, HASHES)
GOOD: dict[str, tuple[bytes, Callable[[bytes], object]]] = {
    "offer": (offer(ROWS).packed(), Offer.unpacked),
    "signed offer": (signed(offer(ROWS), key_of(0)).packed(), Signed.unpacked),
    "manifest": (packed_page(Page(MANIFEST, 0, MANIFEST.root, len(HASHES), 0, HASHES)), unpacked_page),
    "manifest request": (Request("", 3, GONE, 0).packed(), Request.unpacked),
    "tiles request": (packed_wanted("", [(GONE, 0)]), unpacked_wanted),
    "tile part": (packed_part(GONE, 3, 1, b"ab"), lambda data: unpacked_part(data, MOST_TILE_BYTES)),
    "tile": (TILES[(0, 0)], lambda data: rows_of_tile(data, (0, 0), 8)),
    "reply": (Reply("taken", "2 landmarks").packed(), Reply.unpacked),
    "refusal": (Refusal("busy", "later", 2.0, 4).packed(), Refusal.unpacked),
}


def refused(read: Callable[[bytes], object], data: bytes) -> None:
    """It reads, or says one line."""
    try:
        read(data)
    except WireError as e:
        assert "\n" not in str(e) and str(e).isprintable() and len(str(e)) < 400


@pytest.mark.parametrize("name", GOOD)
@settings(max_examples=60, deadline=None)
@given(data=st.binary(max_size=400))
def test_any_bytes_are_one_line(name: str, data: bytes) -> None:
    refused(GOOD[name][1], data)
    packed = zstandard.ZstdCompressor().compress(data)
    refused(GOOD[name][1], packed)


VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats()
    | st.text(max_size=8)
    | st.binary(max_size=70),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@pytest.mark.parametrize("name", [n for n in GOOD if n != "tile"])
@settings(max_examples=60, deadline=None)
@given(choose=st.randoms(use_true_random=False), value=VALUES)
def test_any_value_in_any_field_is_one_line(name: str, choose: random.Random, value: object) -> None:
    data, read = GOOD[name]
    schema, fields = msgpack.unpackb(zstandard.ZstdDecompressor().decompress(data))
    field = choose.choice([*fields, "new"])
    changed = msgpack.packb([schema, fields | {field: value}])
    refused(read, zstandard.ZstdCompressor().compress(changed))
    refused(read, zstandard.ZstdCompressor().compress(msgpack.packb([value, fields])))


@pytest.mark.parametrize("name", GOOD)
def test_any_flipped_bit_and_any_cut_is_one_line(name: str) -> None:
    data, read = GOOD[name]
    rng = np.random.default_rng(3)
    for _ in range(300):
        spoilt = bytearray(data)
        spoilt[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        refused(read, bytes(spoilt))
        refused(read, data[: rng.integers(len(data))])


@pytest.mark.parametrize("name", [n for n in GOOD if n != "tile"])
def test_what_is_too_large_is_not_unpacked(name: str) -> None:
    bomb = zstandard.ZstdCompressor().compress(bytes(200_000_000))
    for data in (bytes(MOST_BYTES + 1), bomb):
        with pytest.raises(WireError, match="expected"):
            GOOD[name][1](data)


@pytest.mark.parametrize("count", [1, 17, len(MAP)])
def test_tiles_come_back_to_the_bit_whatever_is_in_them(count: int) -> None:
    rng = np.random.default_rng(count)
    m = replace(
        MAP.of(np.arange(count)),
        xy_map_m=rng.uniform(-3000.0, 3000.0, (count, 2)),
        ids=np.cumsum(rng.integers(1, 2**40, count)),
    )
    seen_s = rng.uniform(0.0, 2e9, (count, 2))
    once, once_s = joined(cut(m, seen_s, 8), 8)
    assert np.abs(once.xy_map_m - m.xy_map_m).max() < 1e-6
    assert np.abs(once.cov_m2 - m.cov_m2).max() < 1e-6 * m.cov_m2.max()
    assert np.array_equal(once.ids, m.ids) and np.array_equal(once.sightings, m.sightings)
    assert cut(once, once_s, 8) == cut(m, seen_s, 8)


@pytest.mark.parametrize("share", [-0.999999999, 0.0, 0.5, 0.999999999])
def test_correlated_covariances_stay_covariances(share: float) -> None:
    cov = np.array([[4e-6, share * 6e-6], [share * 6e-6, 9e-6]])
    m = replace(MAP.of(np.arange(50)), cov_m2=np.tile(cov, (50, 1, 1)))
    once, _ = joined(cut(m, np.zeros((50, 2)), 8), 8)
    assert np.linalg.eigvalsh(once.cov_m2).min() > 0.0


def test_offers_come_back_within_their_rounding() -> None:
    back = Offer.unpacked(offer(ROWS, session="hall/2026-05-04").packed())
    assert np.abs(back.rows["x"] - ROWS["x"]).max() < 1e-5 and np.array_equal(back.rows["ref"], ROWS["ref"])
    assert (back.session, back.seq, back.base) == ("hall/2026-05-04", 1, 1)


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("xx", np.nan, "not finite"),
        ("xy", np.inf, "not finite"),
        ("xx", -1.0, "sigmas from"),
        ("yy", 0.5 * LEAST_SIGMA_M**2, "sigmas from"),
        ("xx", 1e30, "sigmas from"),
        ("kind", 200, "a kind is 200"),
        ("ref", 2**62 + 1, "too large"),
        ("seen", 11, "seen <= expected"),
    ],
)
def test_what_no_robot_can_have_measured_is_refused(name: str, value: float, said: str) -> None:
    rows = ROWS.copy()
    rows[name][3] = value
    with pytest.raises(WireError, match=said):
        Offer.unpacked(offer(rows).packed())


def test_a_landmark_named_twice_and_a_place_beyond_are_refused() -> None:
    with pytest.raises(WireError, match="named twice"):
        Offer.unpacked(offer(ROWS[[0, 1, 1]]).packed())
    rows = ROWS.copy()
    rows["x"][0] = 40_000.0
    with pytest.raises(WireError, match="beyond 32768 m"):
        offer(rows).packed()


def test_pages_lead_to_the_manifest_that_they_say() -> None:
    first, second = dict(list(HASHES.items())[:1]), dict(list(HASHES.items())[1:])
    pages = [Page(MANIFEST, 0, MANIFEST.root, len(HASHES), n, part) for n, part in ((0, first), (1, second))]
    assert advanced(None, [unpacked_page(packed_page(p)) for p in pages]).hashes == HASHES
    with pytest.raises(WireError, match="its root is"):
        advanced(None, pages[:1])


def test_a_signature_is_of_the_key_of_the_offer_and_of_the_building() -> None:
    good = signed(offer(ROWS), key_of(0))
    assert good.is_genuine("hall")
    assert not good.is_genuine("other")
    assert not replace(good, public=key_of(1).public).is_genuine("hall")
    assert not replace(good, public=bytes(32)).is_genuine("hall")
    assert not replace(good, body=good.body + b"\0").is_genuine("hall")


def test_malformed_offers_are_counted_and_change_nothing(tmp_path: Path) -> None:
    path = surveyed(tmp_path / "b.db")
    curator = Curator(path, mapd())
    curator.tick()
    before = curator.published("")
    rng = np.random.default_rng(8)
    data = GOOD["signed offer"][0]
    inner = Signed.unpacked(data)
    for n in range(100):
        spoilt = bytearray(inner.body)
        spoilt[rng.integers(len(spoilt))] ^= 1 << int(rng.integers(8))
        body = bytes(spoilt) if n % 2 else rng.bytes(300)
        genuine = Signed(inner.public, key_of(0).sign(b"offer.1\nhall\n" + body), body)
        assert genuine.is_genuine("hall")
        (answer,) = curator.take([genuine.packed()])
        assert isinstance(answer, Refusal) and "\n" not in answer.text
    curator.tick()
    after = curator.published("")
    assert before is not None and after is not None and after.root == before.root
    curator.close()
    with Ledger(ledger_of(path)) as ledger:
        assert ledger.counters() == {"refused_malformed": 100}
        assert not len(ledger.claims(""))


def test_an_empty_map_is_no_tiles() -> None:
    assert cut(NOBODY, np.empty((0, 2)), 8) == {}
    assert len(joined({}, 8)[0]) == 0
