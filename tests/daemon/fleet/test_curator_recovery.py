"""A map service that ends at any moment, its versions, a person's edits, a disk that does not take it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fleet_parts import map_of, mapd, measured_both, measured_known, measured_new, offer, root, told

from ceilvo.daemon.fleet.manifests import GONE, Request
from ceilvo.daemon.fleet.offers import Measured
from ceilvo.daemon.fleet.replies import Refusal, Reply
from ceilvo.daemon.fleet.service.curator import Curator
from ceilvo.daemon.fleet.service.ledger import Ledger
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.map.database.copies import copy_of, open_map


def test_a_merge_that_the_map_does_not_have_yet_is_made_up_for(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for after_the_map in (False, True):
        curator = Curator(path, mapd())
        curator.tick()
        before = map_of(path)
        floor = curator._floors[""]
        apply = floor.apply

        def dies(*what: object, after: bool = after_the_map, apply: object = apply) -> None:
            if after:
                apply(*what)  # type: ignore[operator]
            raise KeyboardInterrupt

        monkeypatch.setattr(floor, "apply", dies)
        for number in (0, 1):
            seq = 1 + after_the_map
            rows = (
                measured_both(1 + number)
                if not after_the_map
                else np.concatenate([measured_known(seed=7), _further(number)])
            )
            assert isinstance(told(curator, offer(rows, number=number, seq=seq), number), Reply)
        with pytest.raises(KeyboardInterrupt):
            curator.tick()
        curator.close()
        again = Curator(path, mapd())
        again.tick()
        m = map_of(path)
        assert len(m) == len(before) + 30
        assert int(m.sightings[m.ids >= len(before)].max()) == 20, "once, not twice"
        again.close()


def _further(number: int) -> Measured:
    rows = measured_new(60, seed=number)[30:]
    rows["ref"] -= 1000
    return rows


def test_the_last_good_copy_and_the_ledger_have_it_all(path: Path) -> None:
    curator = Curator(path, mapd())
    curator.tick()
    for number in (0, 1):
        told(curator, offer(measured_both(1 + number), number=number), number)
    curator.tick()
    whole = root(curator)
    curator.close()
    assert copy_of(path).exists()
    data = bytearray(path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 4000] = bytes(4000)
    path.write_bytes(bytes(data))
    again = Curator(path, mapd())
    assert root(again) == whole
    again.close()


def test_versions_ascend_and_say_what_changed(path: Path, curator: Curator) -> None:
    first = curator.published("")
    assert first is not None
    for number in (0, 1):
        told(curator, offer(measured_both(1 + number), number=number), number)
    curator.tick()
    second = curator.published("")
    assert second is not None and second.manifest.version == first.manifest.version + 1
    page = second.page(Request("", first.manifest.version, first.root))
    changed = {p for p, h in second.manifest.hashes.items() if first.manifest.hashes.get(p) != h}
    assert set(page.entries) == changed and page.since == first.manifest.version
    assert second.page(Request("", second.manifest.version, second.root)).total == 0
    whole = second.page(Request("", 99, GONE))
    assert whole.since == 0 and whole.entries == second.manifest.hashes
    other = second.page(Request("", second.manifest.version, first.root))
    assert other.since == 0


def test_a_persons_edit_is_a_new_version(path: Path, curator: Curator) -> None:
    before = root(curator)
    with open_map(path, "") as db:
        content = db.content()
        keep = np.arange(len(content.landmarks)) > 20
        db.edit(replace(content, landmarks=content.landmarks.of(keep), seen_s=content.seen_s[keep]), "forget")
    assert curator.tick()
    assert root(curator) != before
    assert told(curator, offer(measured_known())).state == "taken"  # type: ignore[union-attr]


def test_a_ledger_that_cannot_be_written_refuses_and_loses_nothing(path: Path, curator: Curator) -> None:
    blocker = Ledger(ledger_of(path))
    curator._ledger._db.execute("PRAGMA busy_timeout = 1")
    with blocker.change():
        answer = told(curator, offer(measured_both()))
    assert isinstance(answer, Refusal) and answer.why == "not_written" and answer.wait_s > 0
    blocker.close()
    assert isinstance(told(curator, offer(measured_both())), Reply)
