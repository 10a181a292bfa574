"""The sequential test over places: what is sure, what wins, what is forgotten."""

import numpy as np
import pytest
from beliefs import STEP_M, alike, spot
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.daemon.relocalisation.evidence.wrong_places import ALIKE
from ceilvo.daemon.relocalisation.lattice import of_tracked, rival_poses
from ceilvo.daemon.relocalisation.place_belief import (
    LEAD_M,
    LEAST,
    LEAST_UNKNOWN,
    MOST_PLACES,
    PlaceBelief,
)

RIVALS = np.array([[0.6, 0.0, 0.0], [0.0, -0.6, 0.0], [0.3, 0.3, 0.5 * np.pi]])
LEAD_SPOTS = 1 + int(np.ceil(LEAD_M / STEP_M))
"""The first of them says who leads."""
TRACKED = np.array([2.0, 1.0, 0.4])


def doubted(odds: float = -2.0) -> PlaceBelief:
    belief = PlaceBelief()
    belief.add(RIVALS, np.full(3, odds))
    return belief


def test_a_fresh_belief_is_sure_but_for_what_left_no_trace() -> None:
    assert PlaceBelief().doubt() == pytest.approx(np.exp(LEAST_UNKNOWN), rel=1e-6)
    assert PlaceBelief().winner(1e-4) is None


@settings(max_examples=100, deadline=None)
@given(st.lists(st.lists(st.floats(-6, 6), min_size=4, max_size=4), min_size=1, max_size=5), st.floats(-9, 0))
def test_shares_are_what_bayes_says(ratios: list[list[float]], odds: float) -> None:
    """Products of likelihood ratios over spots, while nothing reaches a floor."""
    belief = doubted(odds)
    belief.doubt_unknown(-1.0)
    weight = np.array([0.0, odds, odds, odds])
    unknown = np.logaddexp(LEAST_UNKNOWN, -1.0)
    for k, r in enumerate(ratios):
        if k:
            belief._settle()
        belief.weigh(alike(np.array(r)))
        weight = weight + r
        if max(weight.max(), unknown) - min(weight.min(), unknown) > -LEAST - 0.1:
            return
    total = np.exp(np.append(weight, unknown)) / np.exp(np.append(weight, unknown)).sum()
    share, none = belief.shares()
    assert np.allclose(share, total[:4], rtol=1e-9)
    assert none == pytest.approx(total[4])
    assert belief.doubt() == pytest.approx(1.0 - total[0])


def test_views_from_one_spot_count_as_one() -> None:
    many, one = doubted(), doubted()
    spot(many, [0.0, -3.0, -3.0, -3.0], views=50)
    spot(one, [0.0, -3.0, -3.0, -3.0])
    assert many.doubt() == pytest.approx(one.doubt())
    spot(one, [0.0, -3.0, -3.0, -3.0])
    assert one.doubt() < 0.2 * many.doubt()


def test_a_rival_wins_only_when_all_others_together_are_less_likely_than_the_rate() -> None:
    belief = doubted()
    spot(belief, [-9.0, 0.0, -9.0, -9.0])
    assert belief.winner(1e-4) is None
    spot(belief, [-9.0, 0.0, -9.0, -9.0])
    for _ in range(LEAD_SPOTS - 1):
        assert belief.doubt() > 1.0 - 1e-4
        assert belief.winner(1e-4) is None  # what one spot shows may be people
        spot(belief, [-9.0, 0.0, -9.0, -9.0])
    assert belief.winner(1e-4) == 1
    belief.cut = True
    assert belief.winner(1e-4) is None


def test_turning_on_the_spot_is_no_lead() -> None:
    belief = doubted()
    for _ in range(20):
        spot(belief, [-9.0, 0.0, -9.0, -9.0], way_m=0.0)
    assert belief.doubt() > 1.0 - 1e-4
    assert belief.winner(1e-4) is None


def test_a_lead_that_was_interrupted_counts_anew() -> None:
    belief = doubted()
    for _ in range(LEAD_SPOTS):
        spot(belief, [-9.0, 0.0, -9.0, -9.0])
    for first, second in ((12.0, -12.0), (-12.0, 12.0)):
        spot(belief, [first, second, -9.0, -9.0])
    assert belief.doubt() > 1.0 - 1e-4
    assert belief.winner(1e-4) is None
    for _ in range(LEAD_SPOTS):
        spot(belief, [-9.0, 0.0, -9.0, -9.0])
    assert belief.winner(1e-4) == 1


def test_the_winner_becomes_the_tracked_place_and_the_old_one_its_rival() -> None:
    belief = doubted()
    spot(belief, [-12.0, -12.0, -12.0, 0.0])
    shares = belief.shares()[0]
    there = belief.jump(3, TRACKED)
    g = RIVALS[2]
    c, s = np.cos(g[2]), np.sin(g[2])
    assert np.allclose(there, [g[0] + c * 2.0 - s * 1.0, g[1] + s * 2.0 + c * 1.0, 0.4 + g[2]])
    assert not np.any(belief.places[0])
    assert belief.shares()[0][0] == pytest.approx(shares[3])
    back = rival_poses(belief.places, there)
    assert np.min(np.hypot(*(back - TRACKED)[:, :2].T)) < 1e-9


def test_places_that_lost_are_dropped_and_a_move_that_left_no_trace_is_found_in_the_end() -> None:
    belief = doubted()
    for _ in range(4):
        spot(belief, [0.0, -9.0, -9.0, -9.0])
    belief.leave_spot()
    assert len(belief) == 1
    belief.add(RIVALS, np.full(3, LEAST))
    belief.weigh(alike(np.array([-15.0, 6.0, -15.0, -15.0])))
    assert belief.doubt() > 1e-4
    for _ in range(LEAD_SPOTS + 1):
        spot(belief, [-15.0, 6.0, -15.0, -15.0])
    assert belief.winner(1e-4) == 1


def test_the_same_place_is_listed_once_and_the_tracked_one_never() -> None:
    belief = doubted(-5.0)
    belief.add(RIVALS + np.array([0.04, -0.04, 0.0]), np.full(3, -5.0))
    assert len(belief) == 4
    assert np.allclose(belief.settled[1:], -5.0 + np.log(2.0))
    belief.add(np.array([[0.05, 0.05, 0.0]]), np.zeros(1))
    assert len(belief) == 4
    belief.add(np.array([[0.05, 0.05, np.pi]]), np.zeros(1))
    assert len(belief) == 5


def test_a_place_that_is_added_in_the_middle_of_a_spot_is_not_behind() -> None:
    belief = PlaceBelief()
    for _ in range(4):
        belief.weigh(alike(np.array([-2.0])))
    belief.add(RIVALS[:1], np.zeros(1))
    belief.weigh(alike(np.array([-2.0, 3.0])))
    weight, _ = belief.weights()
    assert weight[1] - weight[0] == pytest.approx(5.0)


def test_a_place_that_is_added_in_the_middle_of_a_spot_gains_nothing_by_a_poor_view_before() -> None:
    """The tracked place was seen poorly first and well now; the other one as well as it is now."""
    belief = PlaceBelief()
    belief.weigh(alike(np.array([6.4])))
    belief.add(RIVALS[:1], np.zeros(1))
    belief.weigh(alike(np.array([22.0, 22.0])))
    weight, _ = belief.weights()
    assert weight[1] - weight[0] == pytest.approx(0.0)


def beside_one_that_unknown_ground_looks_like(tracked: list[float]) -> PlaceBelief:
    """The likeliest place explains much, but so would one that is alike: unknown ground is as likely, or more."""
    belief = PlaceBelief()
    belief.add(RIVALS[:1], np.zeros(1))
    belief.doubt_unknown(0.0)
    for _ in range(2):
        belief.weigh(np.array([tracked, [16.0, -3.5]]))
        belief._settle()
    assert belief.shares()[1] > 0.9
    return belief


def assert_no_likelier_than_the_ground_it_was_part_of(belief: PlaceBelief) -> None:
    """RIVALS[1], that is found now and then fits."""
    part = -6.0
    belief.add(RIVALS[1:2], np.array([belief.unknown + part - belief.settled[0]]))
    belief.weigh(np.array([[-30.0, -30.0], [-60.0, -60.0], [1.0, 1.0]]))
    share, unknown = belief.shares()
    assert np.argmax(share) == 2
    assert np.log(share[2] / unknown) == pytest.approx(part + 1.0, abs=0.2)


def test_a_place_that_is_found_late_is_no_likelier_than_the_ground_it_was_part_of() -> None:
    """It had the tracked place's past, which no other place had been like: unknown ground was 1e-8 all at once, and a
    robot in a room that had been renovated said TRACKING, 1.5 m off."""
    belief = beside_one_that_unknown_ground_looks_like([-20.0, -18.0])
    assert_no_likelier_than_the_ground_it_was_part_of(belief)


def test_a_place_that_is_found_again_is_no_likelier_than_the_ground_it_was_part_of() -> None:
    """It kept a past that explained less than the likeliest place did and was less like other places; beside that past
    its new weight made unknown ground 1e-4 all at once: another room, with the same tiles, seemed to be this one."""
    belief = PlaceBelief()
    belief.add(RIVALS[:2], np.zeros(2))
    belief.doubt_unknown(0.0)
    for _ in range(2):
        belief.weigh(np.array([[-20.0, -18.0], [16.0, -3.5], [10.0, -4.5]]))
        belief._settle()
    assert_no_likelier_than_the_ground_it_was_part_of(belief)


def test_a_doubt_is_of_the_likeliest_place_too() -> None:
    """A robot that is carried off while another place than the tracked one has all but won."""
    belief = doubted()
    belief.weigh(alike(np.array([-9.0, 3.0, -9.0, -9.0])))
    belief._settle()
    belief.doubt_unknown(np.log(0.5))
    share, unknown = belief.shares()
    assert np.argmax(share) == 1
    assert unknown / share[1] == pytest.approx(0.5, rel=0.01)


def test_a_picture_that_stands_says_no_more_with_every_doubt() -> None:
    """Frozen, with noise, while the wheels turned: each frame was in doubt anew and the same picture proved it wrong
    anew, until all places but the one of the picture were 1e-8 (79 s wrong, half a turn)."""
    odds = []
    for doubts in (1, 50):
        belief = doubted()
        for _ in range(doubts):
            belief.renew()
            belief.weigh(alike(np.array([2.0, 0.0, -1.0, 0.0])))
        odds.append(np.log(belief.shares()[0][1:] / belief.shares()[0][0]))
    assert np.allclose(odds[1], odds[0], atol=1e-6)


def test_a_doubt_at_another_spot_keeps_what_the_last_one_showed() -> None:
    belief = doubted()
    belief.weigh(alike(np.array([2.0, 0.0, -1.0, 0.0])))
    belief.moved(STEP_M, 0.0)
    belief.renew()
    assert np.allclose(belief.settled[1:] - belief.settled[0], [-4.0, -5.0, -4.0])


def test_a_place_at_the_floor_stays_there_when_the_likeliest_one_falls() -> None:
    belief = beside_one_that_unknown_ground_looks_like([-20.0, -18.0])
    belief.weigh(np.array([[0.0, 0.0], [-60.0, -60.0]]))
    share, unknown = belief.shares()
    assert np.argmax(share) == 0 and abs(np.log(share[0] / unknown) - LEAST) < 0.2


@pytest.mark.parametrize("unmapped", [0.0, 1.0])
def test_new_ground_is_no_worse_for_what_a_place_that_is_alike_explains(unmapped: float) -> None:
    """The robot drives on over ground that nobody mapped; half a turn away the map looks the same. Before another place
    led, new ground was given nothing: a doubt of 1e-4 grew until the robot was told that it is half a turn off."""
    belief = PlaceBelief()
    belief.add(RIVALS[:1], np.array([-9.0]))
    for _ in range(6):
        belief.moved(STEP_M, 1.0)
        belief.leave_spot()
        belief.weigh(np.array([[0.0, 0.0], [3.0, 0.05]]), lambda _: (np.array([unmapped, unmapped]), False))
    odds = float(np.log(belief.shares()[0][1] / belief.shares()[0][0]))
    gained = -9.0 + 6 * 0.05 - np.log(ALIKE) if unmapped else -9.0 + 6 * 3.0
    assert odds == pytest.approx(gained, abs=0.2)


def test_more_places_than_are_kept_are_cut_and_that_is_said() -> None:
    rng = np.random.default_rng(7)
    many = np.column_stack([rng.uniform(-500, 500, (MOST_PLACES + 50, 2)), np.zeros(MOST_PLACES + 50)])
    belief = PlaceBelief()
    belief.add(many, rng.uniform(-9, 0, len(many)))
    assert len(belief) == MOST_PLACES
    assert belief.cut
    assert not np.any(belief.places[0])


def test_a_tracked_place_that_is_found_anew_beside_itself_gets_the_past_of_the_likeliest() -> None:
    """8 cm off it matched nothing, and what was found there every time was taken for it, and dropped."""
    belief = doubted()
    belief.doubt_unknown(-1.0)
    for _ in range(3):
        spot(belief, [-9.0, 0.0, -9.0, -9.0])
    belief.leave_spot()
    lost = belief.settled[0]
    belief.again(5.0)
    assert belief.settled[0] == pytest.approx(lost + 5.0)
    belief.again(-5.0)
    assert belief.settled[0] == pytest.approx(lost + 5.0)


def test_a_place_a_few_centimetres_off_is_the_tracked_one_and_a_small_tile_is_not() -> None:
    off = np.array([[0.08, 0.03, 0.0], [0.0, -0.1, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 0.5 * np.pi]])
    assert of_tracked(off).tolist() == [True, True, False, False]


def test_watched_places_keep_what_they_have_and_weak_evidence_adds_up() -> None:
    belief = PlaceBelief()
    for _ in range(50):
        belief.moved(STEP_M, 0.0)
        belief.leave_spot()
        belief.watch(RIVALS)
        belief.weigh(alike(np.zeros(len(belief))))
    assert belief.doubt() < 10 * len(RIVALS) * np.exp(LEAST)
    for _ in range(5):
        belief.moved(STEP_M, 0.0)
        belief.leave_spot()
        belief.watch(RIVALS + 0.04)
        ratio = np.full(len(belief), -6.0)
        ratio[:2] = -2.0, 1.0
        belief.weigh(alike(ratio))
    assert belief.doubt() == pytest.approx(np.exp(LEAST + 15.0), rel=0.5)
    assert len(belief) == 1 + len(RIVALS)


def test_a_watched_place_that_is_a_quarter_turn_off_is_another() -> None:
    belief = PlaceBelief()
    belief.watch(RIVALS[:1])
    belief.watch(RIVALS[:1] + np.array([0.0, 0.0, 0.5 * np.pi]))
    assert len(belief) == 3
