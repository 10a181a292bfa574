"""Places found from one view: against all places by brute force, and against the pose that the view was made from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import place_maps
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.daemon.relocalisation.place_index.blocks import FINE_M
from ceilvo.daemon.relocalisation.place_index.found import CONTRADICTED, EXPLAINED
from ceilvo.daemon.relocalisation.place_index.place_index import MARGIN, PlaceIndex
from ceilvo.daemon.relocalisation.place_index.search import EXPLAINED_FRACTION, Search
from ceilvo.daemon.relocalisation.place_index.type_grid import GROUND_M, HALF_DIAGONAL_M, REACH_M
from ceilvo.se2 import wrap_array
from ceilvo.types import Observations

SURE_M, FURTHEST_M = REACH_M - HALF_DIAGONAL_M - FINE_M, REACH_M + HALF_DIAGONAL_M + FINE_M
"""A landmark so near is found in any cell; one further off in none."""
COUNTS = ("explained", "contradicted", "missed")


@pytest.mark.parametrize("turns", range(4))
def test_a_place_is_found_from_one_view_whatever_the_quarter_turn(turns):
    rng = np.random.default_rng(turns)
    known = place_maps.random_map(rng, 800, 20.0)
    index = PlaceIndex.of(known)
    for pose in ([0.0, 0.0, 0.3], [5.0, -4.0, -2.0], [-7.0, 7.0, 3.0]):
        view = place_maps.view_of(known, pose, rng, turns)
        found = index.candidates(view)
        assert found.complete
        assert found.explained[0] == found.seen == len(view)
        assert found.false_alarm_probability[0] < 1e-3
        refined = index.refined(found.pose[:1], view)[0] - pose
        assert np.hypot(*refined[:2]) < 0.01
        assert abs(wrap_array(refined[2])) < 0.01


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**16),
    st.sampled_from([(20, 3.0), (60, 5.0), (120, 8.0)]),
    st.integers(0, 3),
    st.integers(0, 7),
    st.sampled_from([1.0, 0.8]),
    st.sampled_from([(4,), place_maps.CORNERS, (0, 2, 4, 4, 4, 4, 4, 4)]),
    st.sampled_from([9.0, 0.0]),
)
def test_every_place_within_the_limit_is_listed_and_counted_as_brute_force_does(
    seed, size, turns, extra, keep, kinds, mapped_to_m
):
    rng = np.random.default_rng(seed)
    whole = place_maps.random_map(rng, *size, kinds)
    known = whole.of(whole.xy_map_m[:, 0] < mapped_to_m)
    pose = np.append(rng.uniform(-0.3, 0.3, 2) * size[1], rng.uniform(-3, 3))
    view = place_maps.view_of(whole, pose, rng, turns, extra=extra, keep=keep)
    found = PlaceIndex.of(known).candidates(view)
    counted_as_brute_force_does(found, known, view)
    if found.complete:
        everything_is_listed(found, known, view)
        truly = place_maps.explained(known, pose, view, 0.03)[0]
        if truly >= max(found.floor, found.explained.max()):
            assert place_maps.listed(found.pose, pose)


def counted_as_brute_force_does(found, known, view):
    for i in np.unique(np.linspace(0, len(found) - 1, 12).astype(int)) if len(found) else ():
        counts = [place_maps.explained(known, found.pose[i], view, r)[0] for r in (SURE_M, FURTHEST_M)]
        assert counts[0] <= found.explained[i] <= counts[1]
        least = place_maps.contradicted(known, found.pose[i], view, FURTHEST_M, GROUND_M - HALF_DIAGONAL_M - FINE_M)
        most = place_maps.contradicted(known, found.pose[i], view, SURE_M, GROUND_M + HALF_DIAGONAL_M + FINE_M)
        assert least <= found.contradicted[i] <= most
        least, most = (
            place_maps.missed(known, found.pose[i], view, r, REACH_M + d)
            for r, d in ((FURTHEST_M, HALF_DIAGONAL_M + 0.01), (SURE_M, -HALF_DIAGONAL_M - 0.01))
        )
        assert least <= found.missed[i] <= most


def everything_is_listed(found, known, view):
    """Of all places that lie on mapped ground, or explain enough, those surely within the margin are candidates."""
    places = place_maps.all_places(known, view)
    explained = place_maps.explained(known, places, view, 0.5 * SURE_M)
    enough = explained >= EXPLAINED_FRACTION * found.explained[0]
    for place, count in zip(places[enough], explained[enough], strict=True):
        contradicted = place_maps.contradicted(known, place, view, 0.5 * SURE_M, GROUND_M + 0.2)
        missed = place_maps.missed(known, place, view, 0.5 * SURE_M, 0.0)
        if count < found.floor and count + contradicted < len(view):
            continue
        assert (
            EXPLAINED * count - CONTRADICTED * contradicted - missed <= EXPLAINED * found.explained[0] - found.cost[0]
        )
        if CONTRADICTED * contradicted + missed <= found.limit:
            assert place_maps.listed(found.pose, place, 0.2)


def test_nothing_is_left_out_by_a_limit_that_was_too_strict():
    """At the rim of a map the first good place may cost less than the best one; then all is looked at again."""
    again = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        whole = place_maps.random_map(rng, 150, 8.0)
        index = PlaceIndex.of(whole.of(whole.xy_map_m[:, 0] < 0.5))
        view = place_maps.view_of(whole, [0.0, 0.0, 0.0], rng, extra=6, keep=0.8)
        once, search = (Search.of(index.grid, index.members, view, MARGIN) for _ in range(2))
        once._run_once()
        again += once.strictest < once.limit
        search.run()
        assert search.strictest >= search.limit
    assert again > 0


def test_without_a_map_or_features_or_a_heading_nothing_is_claimed():
    rng = np.random.default_rng(3)
    known = place_maps.random_map(rng, 100, 6.0)
    view = place_maps.view_of(known, [0.0, 0.0, 0.0], rng)
    nothing = place_maps.view_of(known, [100.0, 0.0, 0.0], rng)
    headless = replace(view, heading_var_rad2=np.inf)
    for index, seen in ((PlaceIndex(), view), (PlaceIndex.of(known), nothing), (PlaceIndex.of(known), headless)):
        found = index.candidates(seen)
        assert len(found) == 0
        assert not found.complete
    assert index.candidates(headless).floor > len(view)


def test_features_on_unmapped_ground_say_nothing():
    rng = np.random.default_rng(9)
    whole = place_maps.random_map(rng, 500, 14.0)
    known = whole.of(whole.xy_map_m[:, 0] < 0.4)
    pose = np.array([0.0, 1.0, 0.5])
    view = place_maps.view_of(whole, pose, rng)
    found = PlaceIndex.of(known).candidates(view)
    assert place_maps.listed(found.pose, pose)
    i = int(np.argmin(place_maps.off(found.pose, pose)[0]))
    assert found.explained[i] < 0.9 * found.seen
    assert found.contradicted[i] <= 2
    assert i == 0


def test_a_changed_ceiling_is_recognised_by_the_rest():
    rng = np.random.default_rng(10)
    known = place_maps.random_map(rng, 2000, 31.0)
    index = PlaceIndex.of(known)
    for turns in range(4):
        pose = np.array([*rng.uniform(-10, 10, 2), rng.uniform(-3, 3)])
        view = place_maps.view_of(known, pose, rng, turns, keep=0.8, extra=4)
        found = index.candidates(view)
        assert place_maps.off(found.pose, pose)[0][0] < 0.1
        assert found.seen == len(view)


def test_what_is_not_known_to_be_visible_is_not_missed():
    rng = np.random.default_rng(11)
    known = place_maps.random_map(rng, 200, 8.0)
    view = place_maps.view_of(known, [0.0, 0.0, 0.0], rng, keep=0.5)
    blind = replace(view, visible_m=np.empty((0, 2)))
    index = PlaceIndex.of(known)
    assert index.candidates(view).missed[0] > 3
    assert np.all(index.candidates(blind).missed == 0)


def test_refined_poses_are_at_the_truth_from_a_few_centimetres_off():
    rng = np.random.default_rng(12)
    known = place_maps.random_map(rng, 800, 20.0)
    index = PlaceIndex.of(known)
    poses = np.column_stack([rng.uniform(-7, 7, (20, 2)), rng.uniform(-3, 3, 20)])
    errors = []
    for pose in poses:
        view = place_maps.view_of(known, pose, rng, int(rng.integers(4)), noise_m=0.01, keep=0.8, extra=2)
        start = pose + np.array([0.05, 0.05, 0.01]) * rng.standard_normal(3)
        wrong_quarter = start + np.array([0.0, 0.0, 0.5 * np.pi])
        better, elsewhere = index.refined(np.stack([start, wrong_quarter]), view)
        errors.append(np.hypot(*(better - pose)[:2]))
        assert abs(wrap_array(better[2] - pose[2])) < 0.02
        assert abs(wrap_array(elsewhere[2] - wrong_quarter[2])) < 0.1
    assert np.max(errors) < 0.03
    assert np.median(errors) < 0.01


def test_a_third_of_a_ceiling_hung_anew_does_not_pull_a_refined_pose():
    """Its features lie 0.08 m off, all alike; a mean would be off by a third of that."""
    rng = np.random.default_rng(21)
    known = place_maps.random_map(rng, 800, 20.0)
    index = PlaceIndex.of(known)
    for pose in np.column_stack([rng.uniform(-7, 7, (10, 2)), rng.uniform(-3, 3, 10)]):
        view = place_maps.view_of(known, pose, rng, noise_m=0.003)
        moved = np.array(view.xy_base_m)
        moved[: len(moved) // 3] += np.array([0.08, 0.0])
        better = index.refined(pose[None], replace(view, xy_base_m=moved))[0]
        assert np.hypot(*(better - pose)[:2]) < 0.013


def test_the_heading_is_refined_as_well():
    rng = np.random.default_rng(20)
    known = place_maps.random_map(rng, 800, 20.0)
    for pose in np.column_stack([rng.uniform(-7, 7, (8, 2)), rng.uniform(-3, 3, 8)]):
        view = replace(place_maps.view_of(known, pose, rng, noise_m=0.003), heading_var_rad2=0.02**2)
        for turn in (-0.02, 0.02):
            better = PlaceIndex.of(known).refined((pose + np.array([0.0, 0.0, turn]))[None], view)[0]
            assert abs(wrap_array(better[2] - pose[2])) < 0.005
            assert np.hypot(*(better - pose)[:2]) < 0.01


def test_a_pose_where_nothing_fits_stays_as_it_is():
    rng = np.random.default_rng(13)
    known = place_maps.random_map(rng, 100, 6.0)
    view = place_maps.view_of(known, [0.0, 0.0, 0.0], rng)
    far = np.array([[500.0, 0.0, 0.1]])
    np.testing.assert_array_equal(PlaceIndex.of(known).refined(far, view), far)


def test_views_of_another_building_are_seldom_taken_for_this_one():
    """The stated chance that a wrong place explains as many is not less than the frequency that is found."""
    rng = np.random.default_rng(14)
    known = place_maps.random_map(rng, 400, 14.0)
    index, stated = PlaceIndex.of(known), []
    for _ in range(120):
        view = place_maps.view_of(place_maps.random_map(rng, 60, 6.0), [0.0, 0.0, 0.4], rng, half_m=(0.8, 0.6))
        if len(view) > 1:
            found = index.candidates(view, margin=100.0)
            stated.append(found.false_alarm_probability.min() if len(found) else 1.0)
    for level in (0.05, 0.2, 0.5):
        frequency = np.mean(np.array(stated) < level)
        print(f"stated below {level}: {frequency:.3f} of {len(stated)} views of another building")
        assert frequency <= level + 3 * np.sqrt(level * (1 - level) / len(stated))


def test_a_view_of_hundreds_of_features_costs_no_more_than_of_64():
    rng = np.random.default_rng(15)
    known = place_maps.random_map(rng, 4000, 14.0)
    pose = np.array([1.0, -2.0, 1.0])
    view = place_maps.view_of(known, pose, rng, half_m=(2.0, 2.0))
    assert len(view) > 200
    found = PlaceIndex.of(known).candidates(view)
    assert found.seen == 64
    assert place_maps.listed(found.pose, pose)


def test_any_pose_can_be_counted_as_candidates_are():
    rng = np.random.default_rng(17)
    known = place_maps.random_map(rng, 300, 9.0)
    view = place_maps.view_of(known, [0.0, 0.0, 2.0], rng, 3, keep=0.8, extra=2)
    index = PlaceIndex.of(known)
    found = index.candidates(view, margin=60.0)
    counts = np.array(index.counts(found.pose, view))
    np.testing.assert_array_equal(counts, [found.explained, found.contradicted, found.missed])
    poses = np.column_stack([rng.uniform(-3, 3, (12, 2)), view.heading_rad + 0.5 * np.pi * np.arange(12)])
    counts = index.counts(poses, view)
    counted_as_brute_force_does(replace(found, pose=poses, **dict(zip(COUNTS, counts, strict=True))), known, view)


def test_labels_are_not_looked_at():
    rng = np.random.default_rng(16)
    known = place_maps.random_map(rng, 100, 6.0)
    view = place_maps.view_of(known, [0.0, 0.0, 0.0], rng)
    labelled: Observations = replace(view, label=np.arange(len(view)))
    index = PlaceIndex.of(known)
    np.testing.assert_array_equal(index.candidates(view).pose, index.candidates(labelled).pose)
