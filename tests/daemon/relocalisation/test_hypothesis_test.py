"""An assumed pose against its alternatives whole tiles away."""

import numpy as np
import pytest

from ceilvo.daemon.relocalisation.hypothesis_test import PoseHypothesis, Source
from ceilvo.se2 import compose

NIS, NIS_MAX = 1.0, 3.0


def views(
    own: int,
    alternative: int,
    seen: int,
    count: int,
    source: Source = Source.GIVEN,
    nis: float = NIS,
    reach_m: float = 1.0,
    elsewhere: int = 0,
) -> list[bool]:
    hypothesis = PoseHypothesis(source, reach_m)
    explained = np.array([own, alternative, alternative - 1], float)
    return [hypothesis.weigh(explained, seen, elsewhere, nis, NIS_MAX) for _ in range(count)]


def test_the_better_pose_is_believed_after_a_few_views() -> None:
    assert views(30, 28, 32, 10) == [False] * 5 + [True] * 5
    assert views(30, 20, 32, 10) == [False] * 5 + [True] * 5  # never by a few views alone


def test_where_the_robot_can_be_anywhere_the_same_views_need_to_be_better_or_many() -> None:
    """A stored pose; where the map lacks the right place, one a tile off explains most of what is seen."""
    assert views(30, 28, 32, 50, reach_m=np.inf, elsewhere=-1) == [False] * 39 + [True] * 11
    assert views(32, 28, 32, 50, reach_m=np.inf, elsewhere=-1) == [False] * 11 + [True] * 39
    assert not any(views(32, 28, 32, 500, reach_m=np.inf))  # another place of the map explains as much
    assert views(32, 28, 32, 10, reach_m=np.inf, elsewhere=-4) == [False] * 5 + [True] * 5


@pytest.mark.parametrize("reach_m", [1.0, np.inf])
def test_a_place_that_was_searched_for_needs_many_views_that_fit_nowhere_better(reach_m: float) -> None:
    """Ground that the map lacks looks like some that it has: most features fit, now here and now there."""
    for own, elsewhere, believed in ((49, -1, True), (44, -1, False), (48, 1, False)):
        found = PoseHypothesis(Source.SEARCHED, reach_m)
        so_far = [found.weigh(np.array([own, 40.0, 39.0]), 50, elsewhere, NIS, NIS_MAX) for _ in range(39)]
        assert not any(so_far) and not found.hopeless
        assert found.weigh(np.array([own, 40.0, 39.0]), 50, elsewhere, NIS, NIS_MAX) is believed
        assert found.hopeless is not believed


def test_the_region_stays_where_the_path_led_whatever_is_assumed() -> None:
    start, there, further = np.array([1.0, 2.0, 0.3]), np.array([4.0, 0.5, -1.2]), np.array([0.7, 0.1, 0.4])
    hypothesis = PoseHypothesis(Source.GIVEN, 0.8).jumped(start, there)
    region = hypothesis.region(compose(there, further))
    assert region is not None and region.reach_m == 0.8
    assert np.allclose(region.pose, compose(start, further))
    again = hypothesis.jumped(compose(there, further), start).after_gap(usable=True, reach_m=0.5)
    region = again.region(start)
    assert region is not None and region.reach_m == pytest.approx(1.3)
    assert np.allclose(region.pose, compose(start, further))
    assert PoseHypothesis(Source.GIVEN).region(start) is None


def test_a_bare_grid_never_decides() -> None:
    assert not any(views(30, 30, 30, 1000))


def test_the_worse_pose_is_never_believed() -> None:
    assert not any(views(27, 30, 30, 1000))


def test_a_pose_that_explains_little_is_not_believed_even_if_its_alternatives_explain_less() -> None:
    assert not any(views(10, 2, 30, 100))


def test_innovations_out_of_bounds_are_no_confirmation() -> None:
    assert not any(views(30, 20, 30, 100, nis=10.0))


def test_a_sure_pose_needs_one_view_that_fits() -> None:
    assert views(20, 20, 25, 1, source=Source.GIVEN_CLOSELY) == [True]
    assert views(5, 5, 25, 1, source=Source.GIVEN_CLOSELY) == [False]
    assert views(0, 0, 0, 1, source=Source.GIVEN_CLOSELY) == [False]


def test_without_alternatives_an_unsure_pose_stays_unsure() -> None:
    hypothesis = PoseHypothesis(Source.GIVEN)
    assert not any(hypothesis.weigh(np.array([30.0]), 30, 0, NIS, NIS_MAX) for _ in range(50))


@pytest.mark.parametrize("source", [Source.GIVEN, Source.SEARCHED])
def test_a_pose_that_fits_now_is_not_believed_while_its_views_fit_better_elsewhere(source: Source) -> None:
    """Were the last view enough, a wrong pose would only have to wait for one that fits it as well as the right one."""
    wrong = PoseHypothesis(source)
    believed = []
    for k in range(200):
        believed.append(wrong.weigh(np.array([45.0, 40.0, 39.0]), 50, -1 if k % 10 == 9 else 5, NIS, NIS_MAX))
    assert not any(believed)
    assert wrong.hopeless
    right = PoseHypothesis(source)
    believed = [right.weigh(np.array([49.0, 45.0, 44.0]), 50, 1 if k % 8 == 7 else -2, NIS, NIS_MAX) for k in range(40)]
    assert believed[-1]
    assert not any(believed[:5])
    assert not right.hopeless


def test_a_clearly_better_alternative_is_named_and_a_draw_is_not() -> None:
    hypothesis = PoseHypothesis(Source.GIVEN)
    for _ in range(8):
        assert not hypothesis.weigh(np.array([20.0, 21.0, 27.0]), 30, 0, NIS, NIS_MAX)
    assert hypothesis.better() == 1
    draw = PoseHypothesis(Source.GIVEN)
    for _ in range(9):
        draw.weigh(np.array([20.0, 24.0, 24.0]), 30, 0, NIS, NIS_MAX)
    assert draw.better() is None


@pytest.mark.parametrize(
    ("source", "usable", "after", "reason"),
    [
        (Source.GIVEN_CLOSELY, True, Source.GIVEN, "assumed"),
        (Source.GIVEN, False, Source.GIVEN, "assumed"),
        (Source.DEAD_RECKONED, True, Source.DEAD_RECKONED, "0.60 m driven blind"),
        (Source.DEAD_RECKONED, False, Source.BLIND, "0.60 m driven blind"),
        (Source.CONTRADICTED, True, Source.CONTRADICTED, "what is seen contradicts the map"),
        (Source.SEARCHED, True, Source.SEARCHED, "found elsewhere on the map"),
    ],
)
def test_a_further_blind_path_never_makes_a_pose_better(
    source: Source, usable: bool, after: Source, reason: str
) -> None:
    again = PoseHypothesis(source, 1.0, blind_m=0.6, seen=40, views=3).after_gap(usable, 0.5)
    assert (again.source, again.reason, again.reach_m) == (after, reason, 1.5)
    assert (again.seen, again.views, again.usable) == (0, 0, after is Source.DEAD_RECKONED)
