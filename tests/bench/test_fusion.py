"""The bench itself: what happens in each condition, and that outfits are compared under the same."""

import copy
from itertools import islice, pairwise

import numpy as np
import pytest

from ceilvo.bench.fusion import conditions, robot, run
from ceilvo.bench.fusion.command import pairs_of
from ceilvo.bench.fusion.conditions import CONDITIONS
from ceilvo.bench.fusion.lateness import Lateness
from ceilvo.bench.fusion.robot import TICK_S, Moment, Ride
from ceilvo.bench.fusion.senses import OUTFITS, SENSES
from ceilvo.bench.results.paired import difference

ROOM = (0.0, 0.0, 20.0, 20.0)


@pytest.fixture
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """Conditions begin after two seconds."""
    for module in (conditions, robot, run):
        monkeypatch.setattr(module, "BEGIN_S", 2.0)


def moments(name: str) -> list[Moment]:
    return list(Ride(ROOM, np.zeros(3), CONDITIONS[name], np.random.default_rng(1)))


def way_m(those: list[Moment]) -> float:
    return float(sum(np.hypot(*m.moved[:2]) for m in those))


@pytest.mark.usefixtures("soon")
def test_conditions_are_what_their_names_say() -> None:
    slips = [m for m in moments("slip 20 % for 1 m") if m.slip]
    assert {m.slip for m in slips} == {0.2}
    assert abs(way_m(slips) - 1.0) < 0.01
    assert abs(TICK_S * sum(m.dark for m in moments("blackout 10 s")) - 10.0) < 0.1
    assert abs(way_m([m for m in moments("bare stretch 8 m") if m.bare]) - 8.0) < 0.01
    fastest = max(abs(float(m.moved[2])) for m in moments("fast turns 3 rad/s")) / TICK_S
    assert abs(fastest - 3.0) < 0.01
    carried = [m for m in moments("carried") if m.lifted]
    assert all(m.dark for m in carried)
    assert 1.0 < way_m(carried) < 2.1


@pytest.mark.usefixtures("soon")
def test_a_drive_gives_the_same_figures_again_and_every_outfit_the_same_way() -> None:
    drives = [run.Drive(o, "normal", 3) for o in ("vision", "+ gyro", "+ gyro")]
    rows = [list(islice(d.rows(), 40)) for d in drives]
    assert [r.way_m for r in rows[0]] == [r.way_m for r in rows[1]]
    assert all(np.array_equal(a.error, b.error) for a, b in zip(rows[1], rows[2], strict=True))


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("condition", ["slip 20 % for 1 m", "blackout 10 s", "carried"])
def test_a_drive_that_shares_its_start_is_to_the_bit_the_one_that_is_driven_alone(condition: str) -> None:
    alone = list(islice(run.Drive("+ lamps", condition, 3).rows(), 30))
    before = run.Drive("+ lamps", "normal", 3)
    before.begin()
    for _ in range(2):  # and the first leaves nothing behind for the second
        shared = copy.deepcopy(before)
        shared.meet(condition)
        rows = list(islice(shared.rows(), 30))
        assert [(r.time_s, r.way_m, r.nees, r.estimate.state) for r in rows] == [
            (r.time_s, r.way_m, r.nees, r.estimate.state) for r in alone
        ]
        assert all(np.array_equal(a.error, b.error) for a, b in zip(rows, alone, strict=True))


def test_conditions_share_a_start_where_pictures_are_as_late() -> None:
    shared = run.alike(CONDITIONS)
    assert sorted(name for names in shared for name in names) == sorted(CONDITIONS)
    assert [len({CONDITIONS[name].late_s for name in names}) for names in shared] == [1] * len(shared)
    assert max(map(len, shared)) == len(CONDITIONS) - 1


def test_outfits_grow_by_a_sense_each_and_some_senses_also_stand_alone() -> None:
    worn = list(OUTFITS.values())
    assert all(set(names) <= set(SENSES) for names in worn)
    growing, alone = worn[: len(SENSES) + 1], worn[len(SENSES) + 1 :]
    assert [len(names) for names in growing] == list(range(len(SENSES) + 1))
    assert all(set(a) < set(b) for a, b in pairwise(growing))
    assert sum(len(names) == 1 for names in alone) >= 3


def test_a_sense_is_compared_with_what_has_all_but_it() -> None:
    pairs = pairs_of(list(OUTFITS))
    assert {("+ wheels", "vision"), ("+ gyro", "+ wheels"), ("lamps only", "vision")} <= set(pairs)
    assert {("wheels, lamps", "+ wheels"), ("wheels, lamps", "lamps only")} <= set(pairs)
    assert all(len(set(OUTFITS[a]) - set(OUTFITS[b])) == 1 and set(OUTFITS[b]) < set(OUTFITS[a]) for a, b in pairs)


def test_a_paired_difference_is_clear_where_chance_does_not_do() -> None:
    rng = np.random.default_rng(1)
    ground, noise = 100.0 * rng.standard_normal(30), rng.standard_normal((2, 30))
    same, more = difference(ground + noise[0], ground + noise[1]), difference(ground + 2.0 + noise[0], ground)
    assert same.clear == 0 and abs(same.mean) < 1.0
    assert more.clear == 1 and abs(more.mean - 2.0) < 0.6 and abs(more.error - 30**-0.5) < 0.06
    assert difference(ground, ground).clear == 0 and str(difference(ground, ground)) == "0"
    assert difference(np.array([1.0, 1.1]), np.zeros(2)).clear == 0, "two pairs show little"
    with pytest.raises(ValueError, match="pairs"):
        difference(ground, ground[1:])


def test_pictures_are_as_late_as_is_said() -> None:
    rng, late = np.random.default_rng(1), Lateness(0.08, 0.01, 0.13, 5.0)
    before, after = (np.array([late.of(t, rng) for _ in range(500)]) for t in (4.9, 5.0))
    for drawn, mean_s in ((before, 0.08), (after, 0.13)):
        assert abs(float(np.mean(drawn)) - mean_s) < 0.001
        assert np.all(np.abs(drawn - mean_s) <= 0.01) and np.ptp(drawn) > 0.018
    assert late.most_s == pytest.approx(0.14)
