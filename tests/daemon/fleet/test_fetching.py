"""Fetches that are cut off, spoilt, or from a service that began anew."""

from __future__ import annotations

from pathlib import Path

import pytest
from fleet_parts import DirectLink, Site, held, mapd, surveyed

from ceilvo.daemon.fleet import parts as tile_parts
from ceilvo.daemon.fleet.replies import MANIFEST, TILES
from ceilvo.daemon.fleet.robot.fetching import fetch
from ceilvo.daemon.fleet.robot.link import AwayError
from ceilvo.daemon.fleet.robot.store import HELD, NEXT, FleetStore
from ceilvo.daemon.fleet.service.curator import Curator
from ceilvo.daemon.fleet.wire import WireError


def test_what_changed_is_fetched_and_nothing_else(site: Site) -> None:
    r = site.robot(0)
    first = fetch(r.store, site.link, "")
    assert first.is_new and first.tiles == len(site.manifest.hashes)
    assert not fetch(r.store, site.link, "").is_new
    before = held(r.store)
    site.link.asked.clear()
    site.grows()
    found = fetch(r.store, site.link, "")
    changed = set(site.manifest.hashes.values()) - set(before.hashes.values())
    assert found.tiles == len(changed) and held(r.store).root == site.manifest.root
    site.link.asked.clear()
    assert not fetch(r.store, site.link, "").is_new
    assert [word for word, _ in site.link.asked] == [MANIFEST]


def test_a_fetch_that_is_cut_off_goes_on_where_it_stopped(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ceilvo.daemon.fleet.service.published.PART_BYTES", 600)
    r, came = site.robot(0), 0

    def ends(word: str, answers: list[bytes]) -> list[bytes]:
        """Two parts, then nothing for ever."""
        nonlocal came
        if word != TILES:
            return answers
        came += 1
        if came > 3:
            raise AwayError("away")
        return answers[:2]

    cuts, parts_in = 0, 0
    while True:
        came, site.link.spoil = 0, ends
        try:
            fetch(r.store, site.link, "")
        except AwayError:
            cuts += 1
            left = r.store.missing(site.manifest)
            now = sum(at for at, _ in left.values())
            assert r.store.manifest(HELD) is None and r.store.manifest(NEXT) is not None
            whole = sum(len(d) for h, d in _all_tiles(site).items() if h not in left)
            assert now + whole > parts_in, "nothing that came is fetched again"
            parts_in = now + whole
            r.store.close()
            r.store = FleetStore(r.store.path)  # as after a kill
            continue
        break
    assert cuts > 4 and held(r.store).root == site.manifest.root


def _all_tiles(site: Site) -> dict[bytes, bytes]:
    published = site.curator.published("")
    assert published is not None
    return published.tiles


def test_tiles_that_are_not_what_their_hash_says_are_refused_and_counted(site: Site) -> None:
    r, spoilt = site.robot(0), 0

    def spoils(word: str, answers: list[bytes]) -> list[bytes]:
        nonlocal spoilt
        if word != TILES or spoilt:
            return answers
        out = []
        for data in answers:
            part = tile_parts.unpacked_part(data, 10**6)
            bad = bytes([part.data[40] ^ 1])
            out.append(tile_parts.packed_part(part.name, part.size, part.at, part.data[:40] + bad + part.data[41:]))
            spoilt += 1
        return out

    site.link.spoil = spoils
    found = fetch(r.store, site.link, "")
    assert found.refused == spoilt > 1 and held(r.store).root == site.manifest.root
    assert r.store.counters()["tiles_refused"] == spoilt


@pytest.mark.parametrize("word", [MANIFEST, TILES])
def test_a_service_that_answers_nonsense_changes_nothing(site: Site, word: str) -> None:
    r = site.robot(0)
    r.fetch()
    before, root = r.content, held(r.store).root
    site.grows()
    site.link.spoil = lambda asked, answers: [b"nonsense"] if asked == word else answers
    with pytest.raises(WireError) as e:
        fetch(r.store, site.link, "")
    assert "\n" not in str(e.value)
    assert held(r.store).root == root and r.content is before


def test_a_service_that_began_anew_is_followed(site: Site, tmp_path: Path) -> None:
    site.grows()
    r = site.robot(0)
    r.fetch()
    assert held(r.store).version > 1
    other = Curator(surveyed(tmp_path / "other.db"), mapd())
    other.tick()
    r.link = DirectLink(other)
    r.fetch()
    published = other.published("")
    assert published is not None and held(r.store).root == published.root and held(r.store).version == 1
    other.close()
