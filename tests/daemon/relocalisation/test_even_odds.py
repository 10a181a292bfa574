"""What is seen alone, without where a robot was before: PlaceBelief.beats_all()."""

from __future__ import annotations

import numpy as np
import pytest
from beliefs import spot

from ceilvo.daemon.relocalisation.place_belief import PlaceBelief


def test_a_robot_that_may_be_anywhere_is_not_where_it_was_thought_to_be_for_that_alone() -> None:
    """A twin beside the stored pose was e^13 likelier before anything was seen, and one lamp spoke against it."""
    belief = PlaceBelief()
    near, far = np.array([[1.2, 0.0, 0.0]]), np.array([[40.0, 7.2, 0.0]])
    belief.add(near, np.array([-1.0]))
    belief.add(far, np.array([-14.0]))
    for n in range(14):
        spot(belief, [-9.0, 2.0, 2.2 if n < 10 else 2.0])
    assert belief.winner(1e-4) == 1
    assert not belief.beats_all(1), "seen alone, the other is likelier by e^2"
    for _ in range(8):
        spot(belief, [-9.0, -1.0, 2.0])
    assert belief.winner(1e-4) == 2 and belief.beats_all(2)


def test_places_that_are_found_late_do_not_keep_the_best_from_being_believed() -> None:
    """Every view of a raster has thousands: those that were not there when all were listed are worth little."""
    belief = PlaceBelief()
    belief.add(np.array([[5.0, 0.0, 0.0]]), np.array([-3.0]))
    for n in range(12):
        spot(belief, [-9.0, 4.0, *([4.0] * (len(belief) - 2))])
        belief.add(np.array([[10.0 + n, 3.0, 0.0]]), np.array([-40.0]), late=True)
    assert belief.beats_all(1)
    belief.add(np.array([[90.0, 3.0, 0.0]]), np.array([-40.0]))
    assert not belief.beats_all(1), "one that may have been there all the time"


@pytest.mark.parametrize("seed", range(4))
def test_with_even_odds_before_both_weights_say_the_same(seed: int) -> None:
    """Then the two posteriors of the places are one, whatever is seen, renewed, found again or lost."""
    rng = np.random.default_rng(seed)
    belief = PlaceBelief()
    belief.add(rng.uniform(-30.0, 30.0, (6, 3)) * [1.0, 1.0, 0.0], np.zeros(6))
    for step in range(10):
        spot(belief, rng.normal(0.0, 0.7, len(belief)).tolist())
        if step == 4:
            belief.renew()
        if step == 6:
            belief.jump(1, np.zeros(3))
    apart = belief.evidence - belief.settled
    assert len(belief) == 7 and np.ptp(apart) < 1e-9, f"seed {seed}"
