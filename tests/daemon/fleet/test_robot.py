"""A robot of a fleet: fetches that are cut off or spoilt, offers that wait, its own landmarks, ends at any moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fleet_parts import HALL, SIZE_M, Robot, Site, held

from ceilvo.bench.fleet.robots import AXIS_RAD
from ceilvo.bench.fleet.world import Region
from ceilvo.daemon.fleet.offers import Offer
from ceilvo.daemon.fleet.replies import OFFER
from ceilvo.daemon.fleet.robot.client import Drive, queue, recover, send, take_in
from ceilvo.daemon.fleet.robot.fetching import fetch
from ceilvo.daemon.fleet.robot.link import AwayError
from ceilvo.daemon.fleet.robot.store import TAKEN, TAKING, FleetStore
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.errors import CeilvoError, FileFormatError
from ceilvo.types import Landmarks

# --- its own landmarks


def test_robots_learn_from_each_other_and_keep_their_own(site: Site) -> None:
    r = site.robot(0)
    r.fetch()
    r.drive(Region(np.array([5.0, 0.0]), np.array([12.0, 6.0])))
    own = r.content.landmarks.of(r.content.landmarks.ids >= len(_survey(site)))
    assert len(own) > 50
    assert r.offer() == 1
    site.grows()
    r.fetch()
    m = r.content.landmarks
    fleet = site.curator._floors[""].stored()
    assert fleet is not None and len(np.unique(m.ids)) == len(m)
    ids = set(fleet.landmarks.ids.tolist())
    assert set(m.ids.tolist()) == ids, "all of its own are the fleet's now"
    r.drive()
    assert r.tell() <= 1


def _survey(site: Site) -> Landmarks:
    with_id = site.curator._floors[""].stored()
    assert with_id is not None
    return with_id.landmarks


def test_its_own_stay_under_other_names_where_the_fleet_has_given_theirs_away(site: Site) -> None:
    r = site.robot(0)
    r.fetch()
    r.drive(Region(np.array([5.0, 0.0]), np.array([12.0, 4.0])))
    clash = np.flatnonzero(r.content.landmarks.ids >= len(_survey(site)))
    elsewhere = r.content.landmarks.xy_map_m.copy()
    elsewhere[clash] += np.array([100.0, 0.0])  # nothing of the fleet's is there
    r.content = replace(r.content, landmarks=replace(r.content.landmarks, xy_map_m=elsewhere))
    r.tell()
    site.grows()
    r.fetch()
    m = r.content.landmarks
    own = m.of(m.xy_map_m[:, 0] > 50.0)
    assert len(own) == len(clash) and own.ids.min() > _survey(site).ids.max()
    assert r.tell() == 0, "what was told stays told under the new names"


# --- offers that wait


def test_offers_wait_while_the_service_is_away_and_none_is_lost(site: Site) -> None:
    r = site.robot(0)
    r.fetch()
    site.link.away = True
    for n in range(4):
        r.drive(Region(np.array([2.0 * n, 0.0]), np.array([2.0 * n + 5.0, SIZE_M[1]])))
        with pytest.raises(AwayError):
            r.offer()
    waiting = r.store.waiting()
    assert len(waiting) == 4 and [w.seq for w in waiting] == sorted(w.seq for w in waiting)
    r.store.close()
    r.store = FleetStore(r.store.path)
    site.link.away = False
    assert send(r.store, r.who, site.link).taken == 4 and not r.store.waiting()
    claims = site.curator._ledger.claims("")
    offered = np.concatenate([Offer.unpacked(w.body).rows for w in waiting])
    assert int(claims["seen"].sum()) == int(offered["seen"].sum())


def test_an_answer_that_got_lost_does_not_count_twice(site: Site) -> None:
    r = site.robot(0)
    r.fetch()
    r.drive()

    def loses(word: str, answers: list[bytes]) -> list[bytes]:
        if word == OFFER:
            raise AwayError("the answer got lost")
        return answers

    site.link.spoil = loses
    with pytest.raises(AwayError):
        r.offer()
    before = site.curator._ledger.claims("")
    assert len(before)
    site.link.spoil = lambda word, answers: answers
    assert send(r.store, r.who, site.link).taken == 1
    assert np.array_equal(before, site.curator._ledger.claims(""))


def test_where_there_is_no_room_what_is_learnt_is_told_later(site: Site) -> None:
    r = site.robot(0)
    r.fetch()
    r.drive()
    assert r.tell(most_bytes=100) == 0 and r.store.counters()["offers_no_room"] == 1
    assert r.tell() == 1
    (one,) = r.store.waiting()
    assert int(np.count_nonzero(Offer.unpacked(one.body).rows["ref"] < 0)) > 100


def test_numbers_that_were_used_up_are_passed_over(site: Site) -> None:
    for path in ("first", "second"):  # the second disk's clock is behind
        r = Robot(0, site.link, FleetStore(site.folder / f"{path}.db"))
        r.fetch()
        r.drive()
        clock_ns = 10**18 if path == "first" else 10**15
        queue(r.store, r.who, r.content.landmarks, AXIS_RAD, Drive(), 10**8, lambda clock_ns=clock_ns: clock_ns)
        assert send(r.store, r.who, site.link).taken == 1
        r.store.close()


def test_an_offer_of_ground_that_the_map_does_not_reach_lets_the_others_go_first(site: Site) -> None:
    r = site.robot(0)
    r.fetch()
    r.drive(Region(np.array([11.0, 0.0]), np.array(SIZE_M)))
    r.tell()
    r.drive(Region(np.array([4.0, 0.0]), np.array([9.5, 5.0])))
    r.tell()
    assert len(r.store.waiting()) == 2
    sent = send(r.store, r.who, site.link)
    assert sent.taken == 1 and "known landmarks" in sent.waits and len(r.store.waiting()) == 1


# --- ends at any moment, damage


@pytest.mark.parametrize("written", [False, True])
def test_killed_while_it_takes_the_fleets_map(site: Site, written: bool) -> None:
    r = site.robot(0)
    r.fetch()
    r.drive()
    assert r.offer() == 1
    site.grows()
    fetch(r.store, site.link, "")
    disk = {"map": r.content}

    def dies(content: MapContent) -> None:
        if written:
            disk["map"] = content
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        take_in(r.store, r.content, dies)
    assert r.store.manifest(TAKING) is not None
    r.store.close()
    r.store = FleetStore(r.store.path)
    recover(r.store, disk["map"].landmarks)
    stands_on = r.store.manifest(TAKEN)
    assert stands_on is not None and (stands_on.root == site.manifest.root) == written
    r.content = disk["map"]
    assert r.tell() == 0, "nothing is told that was not measured"


def test_a_map_of_its_own_frame_gives_way_only_when_told(site: Site) -> None:
    r = site.robot(0)
    r.content = MapContent.of(HALL.as_map(np.arange(50), 0.003, np.random.default_rng(1)), AXIS_RAD)
    fetch(r.store, site.link, "")
    with pytest.raises(CeilvoError, match="--replace"):
        take_in(r.store, r.content, lambda content: None)
    found = take_in(r.store, r.content, lambda content: None, replace_all=True)
    assert len(found.content.landmarks) == len(_survey(site)) and found.own == 0


def test_a_damaged_store_is_set_aside_and_a_newer_one_is_left_alone(site: Site) -> None:
    r = site.robot(0)
    r.fetch()
    r.store.close()
    r.store.path.write_bytes(b"SQLite format 3\0" + bytes(5000))
    r.store = FleetStore(r.store.path)
    assert "set aside" in r.store.rejected and "\n" not in r.store.rejected
    fetch(r.store, site.link, "")
    assert held(r.store).root == site.manifest.root
    with r.store.change() as db:
        db.execute("DROP TABLE counters")
    r.store._db.execute("PRAGMA user_version = 99")
    path = r.store.path
    r.store.close()
    with pytest.raises(FileFormatError, match="newer ceilvo"):
        FleetStore(path)
    r.store = FleetStore(site.folder / "other.db")
