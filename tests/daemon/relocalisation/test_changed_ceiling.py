"""A robot that was switched off over night: was it moved, or was its ceiling changed?"""

from __future__ import annotations

import numpy as np
import pytest
from beliefs import spot

from ceilvo.bench.place.faults.changes import NIGHT_S
from ceilvo.daemon.relocalisation import doubts
from ceilvo.daemon.relocalisation.place_belief import PlaceBelief

RATE = 1e-4
TILE_M = np.array([0.6, 0.6])
FAR = np.array([[40.0, 7.2, 0.0]])


def stored(ago_s: float) -> doubts.Doubt:
    return doubts.of_stored(0.01**2 * np.eye(3), ago_s, 0.0)


def believed_after(changed: float) -> int | None:
    """Spots, each e^2 likelier at a far place than on ground that is alike, until it is believed; None: not in 60."""
    belief = PlaceBelief()
    belief.add(FAR, np.array([-14.0]))
    belief.doubt_unknown(-4.0, changed)
    for n in range(60):
        spot(belief, [-20.0, 2.0])
        if belief.winner(RATE) == 1:
            return n + 1
    return None


def test_a_ceiling_is_changed_over_night_and_not_within_an_hour() -> None:
    here = np.array([0.001, -0.001, 0.0005])
    assert stored(1800.0).log_odds_of_change(here, TILE_M) == -np.inf
    assert stored(NIGHT_S).log_odds_of_change(here, TILE_M) == pytest.approx(np.log(doubts.CHANGED_OFF), abs=1.0)
    assert stored(np.inf).log_odds_of_change(here, TILE_M) > -np.inf, "nobody knows for how long"


def test_a_robot_that_stands_askew_was_moved_and_one_along_its_walls_below_other_tiles_was_not() -> None:
    """Against that it was moved to one place of a thousand: whoever carries it does not mind the walls, nor who hangs
    tiles the old ones."""
    night = stored(NIGHT_S)
    askew, along = np.array([0.1, 0.2, 0.5]), np.array([0.1, 0.2, 0.001])
    for here, moved in ((askew, True), (along, False)):
        changed, unknown = night.log_odds_of_change(here, TILE_M), night.unknown_by_tiles(here, TILE_M)
        print(f"tiles off by {here}: changed {changed:.1f}, elsewhere {unknown:.1f}")
        one_place = unknown - np.log(1000.0)
        assert (changed < one_place - 5.0) == moved
        assert (changed > one_place + 1.0) == (not moved)


def test_a_place_has_to_beat_a_changed_ceiling_too() -> None:
    """Lamps that hang in the old raster look like another part of the hall, the longer the better. Before, robots whose
    lamps had been hung anew said TRACKING up to 18 m off after 40 and 70 s."""
    plain, changed, hardly = (believed_after(odds) for odds in (-np.inf, -6.0, -40.0))
    print(f"believed after {plain} spots, {hardly} where a change is hardly possible, {changed} where it is")
    assert plain is not None and plain == hardly
    assert changed is None


def test_what_only_the_right_place_explains_settles_it() -> None:
    """A raster with gaps is alike in one place of many, but no other ceiling is so for ever."""
    belief = PlaceBelief()
    belief.add(FAR, np.array([-14.0]))
    belief.doubt_unknown(-4.0, -6.0)
    for _ in range(40):
        spot(belief, [-20.0, 8.0])
    assert belief.winner(RATE) == 1


@pytest.mark.parametrize("seed", range(4))
def test_leaving_spots_and_new_doubts_change_nothing_of_what_is_known(seed: int) -> None:
    rng = np.random.default_rng(seed)
    belief = PlaceBelief()
    belief.add(rng.uniform(-30.0, 30.0, (6, 3)) * [1.0, 1.0, 0.0], np.full(6, -3.0))
    belief.doubt_unknown(-4.0, -6.0)
    for step in range(8):
        belief.weigh(np.repeat(rng.normal(0.0, 1.0, (len(belief), 1)), 2, axis=1))
        belief.moved(1.0, 0.0)
        before = belief.changed_odds
        belief.renew() if step == 4 else belief.leave_spot()
        assert belief.changed_odds == pytest.approx(before, abs=1e-9), f"seed {seed}, step {step}"


def test_once_another_place_is_believed_nothing_is_left_of_it() -> None:
    belief = PlaceBelief()
    belief.add(FAR, np.array([-3.0]))
    belief.doubt_unknown(-4.0, -6.0)
    belief.jump(1, np.zeros(3))
    assert belief.changed_odds == -np.inf
