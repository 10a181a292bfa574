"""An assumed pose against its rivals whole tiles away."""

import numpy as np
import pytest

from ceilvo.daemon.relocalisation.hypothesis_test import Confirmation, contradicted, explained_at, rival_shifts
from ceilvo.se2 import compose, inverse, transform
from ceilvo.types import Landmarks, Observations

NIS, NIS_MAX = 1.0, 3.0


def views(
    own: int,
    rival: int,
    seen: int,
    count: int,
    sure: bool = False,
    nis: float = NIS,
    reach_m: float = 1.0,
    elsewhere: int = 0,
) -> list[bool]:
    confirmation = Confirmation(sure, reach_m=reach_m)
    explained = np.array([own, rival, rival - 1], float)
    return [confirmation.weigh(explained, seen, elsewhere, nis, NIS_MAX) for _ in range(count)]


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
        found = Confirmation(False, found=True, reach_m=reach_m)
        told = [found.weigh(np.array([own, 40.0, 39.0]), 50, elsewhere, NIS, NIS_MAX) for _ in range(39)]
        assert not any(told) and not found.hopeless
        assert found.weigh(np.array([own, 40.0, 39.0]), 50, elsewhere, NIS, NIS_MAX) is believed
        assert found.hopeless is not believed


def test_home_stays_where_the_way_led_whatever_is_assumed() -> None:
    start, there, further = np.array([1.0, 2.0, 0.3]), np.array([4.0, 0.5, -1.2]), np.array([0.7, 0.1, 0.4])
    hypothesis = Confirmation(False, reach_m=0.8).jumped(start, there)
    home = hypothesis.home(compose(there, further))
    assert home is not None and home.reach_m == 0.8
    assert np.allclose(home.pose, compose(start, further))
    again = hypothesis.jumped(compose(there, further), start).after_gap(carried=True, reach_m=0.5)
    home = again.home(start)
    assert home is not None and home.reach_m == pytest.approx(1.3)
    assert np.allclose(home.pose, compose(start, further))
    assert Confirmation(False).home(start) is None


def test_a_bare_grid_never_decides() -> None:
    assert not any(views(30, 30, 30, 1000))


def test_the_worse_pose_is_never_believed() -> None:
    assert not any(views(27, 30, 30, 1000))


def test_a_pose_that_explains_little_is_not_believed_even_if_its_rivals_explain_less() -> None:
    assert not any(views(10, 2, 30, 100))


def test_innovations_out_of_bounds_are_no_confirmation() -> None:
    assert not any(views(30, 20, 30, 100, nis=10.0))


def test_a_sure_pose_needs_one_view_that_fits() -> None:
    assert views(20, 20, 25, 1, sure=True) == [True]
    assert views(5, 5, 25, 1, sure=True) == [False]
    assert views(0, 0, 0, 1, sure=True) == [False]


def test_without_rivals_an_unsure_pose_stays_unsure() -> None:
    confirmation = Confirmation(sure=False)
    assert not any(confirmation.weigh(np.array([30.0]), 30, 0, NIS, NIS_MAX) for _ in range(50))


@pytest.mark.parametrize("found", [False, True])
def test_a_pose_that_fits_now_is_not_believed_while_its_views_fit_better_elsewhere(found: bool) -> None:
    """Were the last view enough, a wrong pose would only have to wait for one that fits it as well as the right one."""
    wrong = Confirmation(sure=False, found=found)
    told = []
    for k in range(200):
        told.append(wrong.weigh(np.array([45.0, 40.0, 39.0]), 50, -1 if k % 10 == 9 else 5, NIS, NIS_MAX))
    assert not any(told)
    assert wrong.hopeless
    right = Confirmation(sure=False, found=found)
    told = [right.weigh(np.array([49.0, 45.0, 44.0]), 50, 1 if k % 8 == 7 else -2, NIS, NIS_MAX) for k in range(40)]
    assert told[-1]
    assert not any(told[:5])
    assert not right.hopeless


@pytest.mark.parametrize("axis", [0.0, 0.4, -1.2])
def test_rivals_stand_one_tile_away_along_the_axes(axis: float) -> None:
    c, s = np.cos(axis), np.sin(axis)
    grid = 0.6 * np.array([(i, j) for i in range(5) for j in range(5)]) @ np.array([[c, s], [-s, c]])
    n = len(grid)
    kinds = np.full(n, 4)
    landmarks = Landmarks(np.arange(n), grid, np.tile(np.eye(2), (n, 1, 1)), kinds, kinds)
    found = rival_shifts(landmarks, axis)
    shift = found @ np.array([[c, -s], [s, c]])
    assert found.shape == (48, 2)
    assert np.allclose(shift / 0.6, np.round(shift / 0.6))
    assert abs(np.abs(shift).max() - 1.8) < 1e-9
    assert len({(round(float(x), 6), round(float(y), 6)) for x, y in found}) == 48
    double = np.concatenate([grid, grid + 0.03])  # both edges of every joint, of one kind
    both = Landmarks(np.arange(2 * n), double, np.tile(np.eye(2), (2 * n, 1, 1)), np.full(2 * n, 4), np.full(2 * n, 4))
    assert np.allclose(np.sort(np.hypot(*rival_shifts(both, axis).T))[:4], 0.6, atol=0.05)
    few = Landmarks(*(a[:3] for a in (landmarks.ids, grid, landmarks.cov_m2, kinds, kinds)))
    assert rival_shifts(few, axis).shape == (0, 2)


def test_explained_features_are_counted_by_kind_at_every_shift() -> None:
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    landmarks = Landmarks(np.arange(3), xy, np.tile(np.eye(2), (3, 1, 1)), np.array([4, 4, 2]), np.ones(3, np.int64))
    pose = np.array([2.0, 3.0, 0.5 * np.pi])
    seen = (xy + np.array([0.6, 0.0]) - pose[:2]) @ np.array([[0.0, -1.0], [1.0, 0.0]])  # as from 0.6 m further on
    o = Observations(seen, np.ones((3, 2)), np.array([4, 4, 8]), np.full(3, -1), 0.0, 1.0, 0.0)
    counts = explained_at(np.array([[0.0, 0.0], [-0.6, 0.0], [0.4, 0.0]]), pose, o, landmarks, 0.2)
    assert counts.tolist() == [0.0, 2.0, 1.0]


def test_a_clearly_better_rival_is_named_and_a_draw_is_not() -> None:
    confirmation = Confirmation(sure=False)
    for _ in range(8):
        assert not confirmation.weigh(np.array([20.0, 21.0, 27.0]), 30, 0, NIS, NIS_MAX)
    assert confirmation.better() == 1
    draw = Confirmation(sure=False)
    for _ in range(9):
        draw.weigh(np.array([20.0, 24.0, 24.0]), 30, 0, NIS, NIS_MAX)
    assert draw.better() is None


def labelled(landmarks: Landmarks, at: np.ndarray, believed: np.ndarray) -> Observations:
    """What is seen from `at` within 1.3 m, labelled as seen from where the robot believes to be."""
    near = np.hypot(*(landmarks.xy_map_m - at[:2]).T) < 1.3
    xy = transform(inverse(at), landmarks.xy_map_m[near])
    apart = np.hypot(*(transform(believed, xy)[:, None] - landmarks.xy_map_m).transpose(2, 0, 1))
    label = np.where(apart.min(axis=1) < 0.2, apart.argmin(axis=1), -1)
    n = int(near.sum())
    turns = np.round((believed[2] - at[2]) / (0.5 * np.pi))
    heading = float(at[2] + 0.5 * np.pi * turns)
    return Observations(xy, np.ones((n, 2)), landmarks.crossing_type[near], label, heading, 1.0, 0.0)


def test_a_view_contradicts_a_pose_by_its_lines_or_by_what_is_not_on_mapped_ground() -> None:
    rng = np.random.default_rng(5)
    xy = np.array([(0.6 * i, 0.6 * j) for i in range(10) for j in range(10)]) + rng.uniform(-0.2, 0.2, (100, 2))
    kinds = np.full(100, 4)
    landmarks = Landmarks(np.arange(100), xy, np.tile(np.eye(2), (100, 1, 1)), kinds, kinds)
    at = np.array([2.7, 2.7, 0.3])
    for believed, contradicts in (
        (at, False),
        (at + np.array([0.05, -0.05, 0.02]), False),
        (at + np.array([0.0, 0.0, 0.3]), True),  # the ceiling's lines give the heading away
        (at + np.array([0.31, 0.28, 0.0]), True),
        (at + np.array([30.0, 0.0, 0.0]), False),  # nothing is mapped there
    ):
        seen = labelled(landmarks, at, believed)
        assert contradicted(seen, believed, landmarks) is contradicts, believed
    edge = np.array([5.4, 2.7, 0.0])  # half of the view is beyond the map
    assert not contradicted(labelled(landmarks, edge, edge), edge, landmarks)
