"""Where hands can have brought the robot, and what a place that is alike gains on new ground beyond that."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from place_maps import tiles, view_of

from ceilvo.config import Filter
from ceilvo.daemon.odometry.course import JUMPED
from ceilvo.daemon.relocalisation import doubts
from ceilvo.daemon.relocalisation.doubts import MOST_DOUBTS, Reach
from ceilvo.daemon.relocalisation.evidence.wrong_places import guessed, too_much
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.relocalisation.lattice import rival_from_tracked
from ceilvo.daemon.relocalisation.place_belief import LEAST, PlaceBelief
from ceilvo.daemon.relocalisation.relocaliser_state import RelocaliserState
from ceilvo.daemon.relocalisation.survey import MapSurvey
from ceilvo.daemon.replay.snapshot import read_value, value_json

POSE = np.array([3.0, -2.0, 0.7])
HALF_TURN_BESIDE = rival_from_tracked((POSE + np.array([0.4, 0.2, np.pi]))[None], POSE)
"""A place half a turn from where the robot stands: transforms in map leave it there as the robot drives on."""


def gap(blind_s: float, bridged: bool = True) -> doubts.Doubt:
    return doubts.of_gap(1e-6 * np.eye(3), blind_s, JUMPED, 0.0, bridged=bridged)


def reached(*all_doubts: doubts.Doubt) -> Reach:
    reach = Reach()
    for doubt in all_doubts:
        reach.take(doubt, POSE)
    return reach


@settings(max_examples=200, deadline=None)
@given(st.floats(0.03, 1.0), st.floats(0.0, 0.99), st.floats(-np.pi, np.pi), st.floats(-0.99, 0.99))
def test_what_a_hand_does_in_a_gap_is_within_its_reach(blind_s: float, speed: float, way: float, turn: float) -> None:
    """Moved at up to 4 m/s in any direction and turned at up to 5 rad/s, anywhere on the map."""
    moved_m, turned_rad = doubts.CARRY_MPS * speed * blind_s, doubts.TURN_RADPS * turn * blind_s
    there = POSE + np.array([moved_m * np.cos(way), moved_m * np.sin(way), turned_rad])
    assert not np.any(reached(gap(blind_s)).beyond(rival_from_tracked(there[None], POSE)))


@pytest.mark.parametrize(
    ("all_doubts", "beyond"),
    [
        ((), False),
        ((gap(0.1),), True),
        ((gap(0.1), gap(0.2), gap(0.3)), True),
        ((gap(0.1), gap(0.6)), False),
        ((gap(0.1), doubts.of_gap(1e-6 * np.eye(3), 0.1, 0.0, 0.0, bridged=True)), False),
        ((gap(0.1), doubts.of_gap(np.diag([0.1, 0.1, 1.0]), 0.1, JUMPED, 0.0, bridged=True)), False),
        ((gap(0.1), gap(0.2, bridged=False)), False),
        ((gap(0.1), doubts.of_stored(1e-4 * np.eye(3), np.inf, 0.0)), False),
        ((gap(0.1), doubts.of_suspicion("wheels turn, the picture stands", 1.0, None)), False),
        ((doubts.both(gap(0.1), gap(0.1)),), True),
        ((doubts.both(gap(0.3), gap(0.3)),), False),
        ((gap(0.1),) * (MOST_DOUBTS + 1), False),
    ],
    ids=[
        "nothing happened",
        "a short gap",
        "short gaps, each by itself",
        "one of them was long",
        "a gap in which nobody lifted it, but something else may have",
        "a gap in which its own turn is not known",
        "a gap that no view bridged, so that the robot may have been carried on",
        "a restart",
        "senses that contradict each other",
        "two before one view, short together",
        "two before one view, long together",
        "more than are told apart",
    ],
)
def test_half_a_turn_takes_a_hand_its_time(all_doubts: tuple[doubts.Doubt, ...], beyond: bool) -> None:
    assert reached(*all_doubts).beyond(HALF_TURN_BESIDE).tolist() == [beyond]


def test_reach_is_counted_from_where_the_robot_was_when_the_doubt_came() -> None:
    """A quarter turn about a point 8 m away is 11 m from there, and none at all at that point."""
    quarter_about = rival_from_tracked(np.array([[0.0, 0.0, 0.5 * np.pi]]), np.zeros(3))
    near, far = Reach(), Reach()
    near.take(gap(0.3), np.array([0.1, 0.0, 0.2]))
    far.take(gap(0.3), np.array([8.0, 0.0, 0.2]))
    assert not near.beyond(quarter_about)[0] and far.beyond(quarter_about)[0]


def test_what_the_index_finds_is_left_out_only_beyond_what_a_fast_carry_reaches() -> None:
    """In 0.3 s a hand moves it by 1.2 m, which a metre before and one after make 3.2 m; twice as fast 4.4 m."""
    off = np.array([[2.0, 0.0, 0.0], [4.3, 0.0, 0.0], [4.5, 0.0, 0.0], [0.0, 0.0, np.pi]])
    places, reach = rival_from_tracked(POSE + off, POSE), reached(gap(0.3))
    assert reach.beyond(places).tolist() == [False, True, True, True]
    assert reach.beyond(places, doubts.FASTER).tolist() == [False, False, True, True]
    assert not np.any(Reach().beyond(places, doubts.FASTER))


def test_a_rival_that_nobody_can_have_carried_it_to_is_no_rival() -> None:
    """Half a turn at the same spot within 0.13 s: not the share of it that a hand's other places get."""
    off = np.array([[0.6, 0.0, 0.0], [0.0, 0.0, np.pi], [0.0, 0.6, 0.5 * np.pi]])
    within, half_turn, quarter = gap(0.13).log_odds(off, np.zeros(3), np.array([0.6, 0.6]))
    assert half_turn == LEAST and within > -4.0 and quarter == within
    slower = gap(0.6).log_odds(off, np.zeros(3), np.array([0.6, 0.6]))
    assert np.ptp(slower) < 1e-9


def test_a_recording_keeps_what_hands_may_have_done() -> None:
    reach = reached(gap(0.1), gap(0.2), doubts.both(gap(0.1), gap(0.1)))
    again = read_value(value_json(reach), Reach)
    assert again is not None and value_json(again) == value_json(reach)
    assert again.beyond(HALF_TURN_BESIDE)[0] and reach.beyond(HALF_TURN_BESIDE)[0]


@pytest.mark.parametrize("beyond", [False, True])
def test_a_twin_that_no_hand_can_have_reached_gains_nothing_on_new_ground(beyond: bool) -> None:
    """Lamps of new ground hang as they do half a turn away on the map. As far as the map says how alike its ground is,
    six of them prove the twin; where nobody can have turned the robot so, they say that ceilings are alike."""
    belief = PlaceBelief()
    belief.add(np.array([[0.0, 0.0, np.pi]]), np.array([-5.0]))
    for _ in range(6):
        belief.moved(0.3, 0.0)
        belief.leave_spot()
        belief.weigh(np.array([[0.0, 0.0], [5.0, 1.4]]), lambda _: (np.ones(2), beyond))
    share, _ = belief.shares()
    print(f"beyond reach {beyond}: tracked place {share[0]:.3f}, twin {share[1]:.3f}")
    assert (share[0] > 0.1) if beyond else (share[1] > 0.9)


@pytest.mark.parametrize(("lamps", "few"), [(3, True), (25, False)])
def test_how_alike_a_ceiling_is_that_shows_a_few_lamps_is_a_guess(lamps: int, few: bool) -> None:
    """However near a place is: three lamps of a room say nothing of the others."""
    at = np.random.default_rng(4).permutation(np.argwhere(np.ones((14, 14))))[:lamps]
    landmarks, pose = tiles(14, 14, 0.6, at), np.array([4.0, 4.0, 0.1])
    filter_, state = make_filter(Filter(), np.random.default_rng(1)), RelocaliserState()
    filter_.reset(pose, 1e-6 * np.eye(3), landmarks)
    state.survey = MapSurvey.of(landmarks, 0.0)
    state.survey.around(filter_, view_of(landmarks, pose, np.random.default_rng(2)), pose, 2.0, 0.0)
    assert state.survey.few == few
    state.belief.add(np.array([[0.6, 0.0, 0.0]]), np.array([-5.0]))
    assert state.likeness_is_a_guess(1).tolist() == [few, False], "beside the tracked place, whatever happened"


def test_where_a_hand_brought_the_robot_is_told_by_what_the_map_says_of_likeness() -> None:
    """Of few lamps: places off the map are no likelier for a guess, or nothing could find the robot again."""
    belief = PlaceBelief()
    belief.add(np.array([[0.6, 0.0, 0.0], [9.0, 0.0, 0.0]]), np.array([-3.0, -3.0]))
    for _ in range(12):
        belief.moved(0.3, 0.0)
        belief.leave_spot()
        ratio = np.array([[-3.0, -3.0], [5.0, 1.4], [0.0, 0.0]])
        belief.weigh(ratio, lambda _: (np.array([0.0, 0.0, 1.0]), np.array([True, False, False])))
    share, unknown = belief.shares()
    print(f"tracked, right, off the map: {share}, unknown {unknown:.2e}")
    assert np.argmax(share) == 1 and 1.0 - share[1] < 1e-4


def test_a_whole_search_takes_the_unlisted_places_from_unknown_ground() -> None:
    """A hand of 3 s brings a robot 13 m: of what is not listed one by one 19 of 20 parts were on the map."""
    state, doubt = RelocaliserState(), gap(3.0)
    state.doubt_unknown(doubt, doubt.unknown, -np.inf)
    before = state.belief.unknown
    state.were_listed(whole=False)
    assert state.belief.unknown == before and not state.searched
    state.belief.cut = False
    state.were_listed(whole=True)
    off_map = np.log(doubts.OFF_MAP * doubt.elsewhere / (1.0 - doubt.elsewhere))
    print(f"unknown {before:.2f} -> {state.belief.unknown:.2f}, off the map alone {off_map:.2f}")
    assert state.searched and off_map < state.belief.unknown < off_map + 0.2 < before
    again = state.belief.unknown
    state.were_listed(whole=True)
    assert again - state.belief.unknown < 0.2, "they are taken once"


def test_near_rivals_are_all_listed_one_by_one() -> None:
    assert gap(0.5).unlisted == 0.0 and 0.0 < gap(3.0).unlisted < 1.0 - doubts.OFF_MAP


@settings(max_examples=100, deadline=None)
@given(st.floats(-20, 60), st.floats(-20, 30))
def test_a_guess_of_likeness_never_says_more_than_what_is_known_of_it(any_: float, alike: float) -> None:
    seen = np.array([any_, alike])
    assert guessed(seen)[0] == any_ and guessed(seen)[1] <= alike
    assert too_much(guessed(seen)) >= too_much(seen) - 1e-9
