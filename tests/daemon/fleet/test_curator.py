"""What a service takes and what not: policies, quorum, wrong and hostile robots, ends at any moment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fleet_parts import (
    HALL,
    MAP,
    NEW,
    TRUTH,
    map_of,
    mapd,
    measured_both,
    measured_known,
    measured_new,
    offer,
    root,
    told,
)

from ceilvo.bench.fleet.robots import AXIS_RAD, key_of
from ceilvo.daemon.fleet.offers import Measured, signed
from ceilvo.daemon.fleet.replies import Refusal, Reply
from ceilvo.daemon.fleet.service.admission import BURST, MOST_PENDING
from ceilvo.daemon.fleet.service.curator import Curator
from ceilvo.daemon.fleet.service.ledger import APPROVED, PENDING, REJECTED, Ledger
from ceilvo.daemon.fleet.service.tables import ledger_of
from ceilvo.daemon.map.database.copies import open_map


def unmoved(path: Path, curator: Curator, answer: Reply | Refusal, said: str, why: str) -> None:
    """It was refused with one line, and what others use is as it was."""
    before = root(curator)
    curator.tick()
    assert isinstance(answer, Refusal) and answer.why == why, answer
    assert said in answer.text and "\n" not in answer.text
    assert root(curator) == before and len(map_of(path)) == len(MAP)


# --- who and what is refused


def moved(rows: Measured, factor: complex, shift: complex = 0.0) -> Measured:
    out = rows.copy()
    z = (rows["x"] - 4.0 + 1j * (rows["y"] - 5.0)) * factor + shift
    out["x"], out["y"] = z.real + 4.0, z.imag + 5.0
    return out


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (moved(measured_both(), 1.0, 0.3), "m beside the map"),
        (moved(measured_both(), np.exp(1j * np.radians(1.5))), "turned by +1."),
        (moved(measured_both(), 1.02), "+2.00 % larger"),
        (moved(measured_both(), 1.0, 3000.0), "beside the map"),
        (moved(measured_known(sigma_m=0.03), np.exp(1j * np.radians(1.5))), "turned by"),
    ],
    ids=["shifted", "turned", "scaled", "far away", "turned and vague"],
)
def test_a_map_that_does_not_lie_on_the_fleets_is_refused(
    path: Path, curator: Curator, rows: Measured, said: str
) -> None:
    unmoved(path, curator, told(curator, offer(rows)), said, "disagrees")
    unmoved(path, curator, told(curator, offer(rows), 3), said, "disagrees")  # whoever signs it


def test_axes_of_another_frame_are_refused(path: Path, curator: Curator) -> None:
    unmoved(path, curator, told(curator, offer(measured_both(), axis_rad=AXIS_RAD + 0.1)), "+5.7 deg", "disagrees")


def test_a_key_nobody_knows_and_one_taken_back_are_refused(path: Path, curator: Curator) -> None:
    unmoved(path, curator, told(curator, offer(measured_both()), 9), "is not one of ours", "unknown_key")
    with Ledger(ledger_of(path)) as ledger:
        ledger.remove_key(ledger.keys()[key_of(0).public].number, 1.0)
    unmoved(path, curator, told(curator, offer(measured_both())), "was taken back", "unknown_key")


def test_a_signature_of_somebody_else_or_for_elsewhere_is_refused(path: Path, curator: Curator) -> None:
    forged = replace(signed(offer(measured_both()), key_of(9)), public=key_of(0).public)
    unmoved(path, curator, curator.take([forged.packed()])[0], "not signed with key", "signature")
    elsewhere = signed(offer(measured_both(), service="other"), key_of(0))
    unmoved(path, curator, curator.take([elsewhere.packed()])[0], "not signed with key", "signature")


def test_what_was_sent_before_counts_once(path: Path, curator: Curator) -> None:
    data = signed(offer(measured_both(), seq=5), key_of(0)).packed()
    assert [type(a) for a in curator.take([data, data])] == [Reply, Reply]
    again = curator.take([data])[0]
    assert isinstance(again, Reply) and "known already" in again.text
    unmoved(path, curator, told(curator, offer(measured_known(seed=2), seq=5)), "offer 5 comes after 5", "replayed")
    with Ledger(ledger_of(path)) as ledger:
        assert int(ledger.claims("")["seen"].max()) == 10


def test_too_many_offers_are_told_to_wait(path: Path) -> None:
    now_ns = [0]
    curator = Curator(path, mapd(offers_per_hour=3600.0), monotonic_ns=lambda: now_ns[0])
    curator.tick()
    answers = [told(curator, offer(measured_known(seed=n), seq=n)) for n in range(1, BURST + 2)]
    assert all(isinstance(a, Reply) for a in answers[:-1])
    unmoved(path, curator, answers[-1], "more than 3600 offers", "too_many")
    assert isinstance(
        told(curator, offer(measured_known(seed=99), number=1, seq=1), 1), Reply
    )  # others are not kept from theirs
    now_ns[0] = 2 * 10**9
    assert isinstance(told(curator, offer(measured_known(seed=99), seq=BURST + 1)), Reply)
    curator.close()


def test_ground_that_nothing_ties_to_the_map_waits(path: Path, curator: Curator) -> None:
    few = np.concatenate([measured_known(7), measured_new()])
    unmoved(path, curator, told(curator, offer(few)), "7 known landmarks, expected 8", "unchecked")
    far = measured_both()
    far["x"][-1] += 60.0
    unmoved(path, curator, told(curator, offer(far)), "from the next known one", "unchecked")


# --- quorum


def test_as_many_robots_as_must_agree_change_the_map_and_fewer_do_not(path: Path, curator: Curator) -> None:
    before = root(curator)
    assert isinstance(told(curator, offer(measured_both(1))), Reply)
    curator.tick()
    assert root(curator) == before
    assert isinstance(told(curator, offer(measured_both(2), number=1), 1), Reply)
    curator.tick()
    m = map_of(path)
    assert len(m) == len(MAP) + 30 and root(curator) != before
    added = m.of(m.ids >= len(MAP))
    off = np.hypot(*(added.xy_map_m - HALL.xy_m[NEW[:30]]).T)
    assert off.max() < 0.012 and np.array_equal(added.crossing_type, HALL.kind[NEW[:30]])
    both_saw = np.intersect1d(measured_known(seed=1)["ref"], measured_known(seed=2)["ref"])
    better = np.hypot(*(m.xy_map_m[both_saw] - TRUTH[both_saw]).T)
    assert np.mean(better**2) < 0.8 * np.mean(np.hypot(*(MAP.xy_map_m[both_saw] - TRUTH[both_saw]).T) ** 2)
    alone = np.setdiff1d(measured_known(seed=1)["ref"], both_saw)
    assert np.array_equal(m.xy_map_m[alone], MAP.xy_map_m[alone])


def test_one_robot_is_one_however_often_it_offers(path: Path, curator: Curator) -> None:
    before = root(curator)
    for n in range(1, 6):
        assert isinstance(told(curator, offer(measured_both(n), seq=n)), Reply)
    curator.tick()
    assert root(curator) == before


def test_robots_that_see_different_things_do_not_agree(path: Path, curator: Curator) -> None:
    before = root(curator)
    for number, shift in ((0, 0.0), (1, 0.05)):
        rows = np.concatenate([measured_known(seed=number), measured_new(seed=number, shift_m=shift)])
        assert isinstance(told(curator, offer(rows, number=number), number), Reply)
    curator.tick()
    assert root(curator) != before and len(map_of(path)) == len(MAP)  # known ones only


def test_what_enough_robots_miss_is_gone_and_one_cannot_make_it_so(path: Path, curator: Curator) -> None:
    for number in (0, 1):
        rows = measured_known(60, seed=9)
        rows["seen"][:10], rows["expected"][:10] = 1, 40
        assert isinstance(told(curator, offer(rows, number=number), number), Reply)
        curator.tick()
        assert len(map_of(path)) == len(MAP) - 10 * number
    assert not np.isin(measured_known(60, seed=9)["ref"][:10], map_of(path).ids).any()


def test_a_boaster_pulls_no_further_than_the_others(path: Path) -> None:
    curator = Curator(path, mapd(quorum=3))
    curator.tick()
    for number in range(3):
        rows = measured_known(seed=4)
        if number == 2:  # as far off as is not noticed, and very sure of it
            rows["x"] += 0.004
            for name, value in (("xx", 1e-7), ("xy", 0.0), ("yy", 1e-7)):
                rows[name] = value
        assert isinstance(told(curator, offer(rows, number=number), number), Reply)
    curator.tick()
    which = measured_known(seed=4)["ref"]
    honest = measured_known(seed=4)["x"]
    pulled = map_of(path).xy_map_m[which, 0] - (0.5 * honest + 0.5 * MAP.xy_map_m[which, 0])
    assert abs(np.mean(pulled)) < 0.002
    curator.close()


# --- policies


def test_trusted_keys_need_nobody_and_others_are_not_heard(path: Path) -> None:
    curator = Curator(path, mapd(policy="trusted"))
    curator.tick()
    unmoved(path, curator, told(curator, offer(measured_both())), "not trusted", "not_trusted")
    assert isinstance(told(curator, offer(measured_both(), number=3), 3), Reply)
    curator.tick()
    assert len(map_of(path)) == len(MAP) + 30
    curator.close()


def test_a_person_approves_and_rejects(path: Path) -> None:
    curator = Curator(path, mapd(policy="approve"))
    curator.tick()
    before = root(curator)
    for number in (0, 1):
        answer = told(curator, offer(measured_both(number), number=number), number)
        assert isinstance(answer, Reply) and answer.state == PENDING
    curator.tick()
    assert root(curator) == before
    with Ledger(ledger_of(path)) as ledger:  # as another process does
        first, second = (e.number for e in ledger.entries(PENDING))
        assert ledger.set_state([first], PENDING, REJECTED) == 1
        curator.tick()
        assert root(curator) == before
        assert ledger.set_state([second], PENDING, APPROVED) == 1
        curator.tick()
        assert len(map_of(path)) == len(MAP) + 30
        assert not ledger.entries(PENDING)
    answers = [told(curator, offer(measured_known(seed=n), seq=10 + n)) for n in range(BURST)]
    assert all(isinstance(a, Reply) for a in answers)
    assert MOST_PENDING > BURST
    curator.close()


def test_a_floor_begins_with_a_trusted_or_an_approved_map(path: Path) -> None:
    curator = Curator(path, mapd())
    assert told(curator, offer(measured_new(), floor="2")).why == "no_map"  # type: ignore[union-attr]
    assert isinstance(told(curator, offer(measured_new(), number=3, floor="2"), 3), Reply)
    curator.tick()
    published = curator.published("2")
    assert published is not None and published.manifest.axis_rad == AXIS_RAD
    assert isinstance(told(curator, offer(measured_new(), number=3, floor=""), 3), Refusal)
    curator.close()
    with open_map(path, "2") as db:
        assert len(db.content().landmarks) == 30
    again = Curator(path, mapd())
    assert sorted(again.floors()) == ["", "2"]
    again.close()
