"""Editing as geometry: regions, turning, aligning, merging, and what a robot makes of the result."""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from map_contents import content, covariances, landmarks, same_content

from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.editing.changes import alignment, moved, only, turn_about, without
from ceilvo.daemon.editing.joining import GATE_CHI2, have_same_ids, matches_by_id, matches_by_place, merged
from ceilvo.daemon.editing.regions import Mark, box, mark, polygon
from ceilvo.daemon.map.database.content import MapContent, Session
from ceilvo.errors import CeilvoError
from ceilvo.se2 import compose, inverse, rotation, transform
from ceilvo.types import NO_LANDMARK, Array, Landmarks

metres = st.floats(-100.0, 100.0)
angles = st.floats(-3.1, 3.1)


def seen_from(m: MapContent) -> Array:
    """(O, 2) where the features of the first session's views are in the map."""
    k = m.key_poses[0]
    return np.array([transform(k.pose[v], xy[None])[0] for v, xy in zip(k.view, k.xy_base_m, strict=True)])


def test_a_region_and_the_rest_are_all_of_it() -> None:
    whole, region = content(300), polygon("2,2 12,3 14,12 6,9")
    inside, outside = only(whole, region.holds), without(whole, region.holds)
    assert len(inside.landmarks) > 20 and len(outside.landmarks) > 100
    assert sorted([*inside.landmarks.ids, *outside.landmarks.ids]) == whole.landmarks.ids.tolist()
    assert np.all(region.holds(inside.landmarks.xy_map_m)) and not np.any(region.holds(outside.landmarks.xy_map_m))
    for part, holds in ((inside, True), (outside, False)):
        k = part.key_poses[0]
        assert len(k) and np.all(region.holds(k.pose[:, :2]) == holds)
        assert np.all(region.holds(seen_from(part)) == holds), "a view into what was forgotten would bring it back"
        assert np.all(np.isin(k.landmark, [*part.landmarks.ids, NO_LANDMARK]))
        assert len(part.seen_s) == len(part.landmarks) and part.sessions == whole.sessions
    assert len(inside.key_poses[0]) + len(outside.key_poses[0]) == len(whole.key_poses[0])


def test_polygons_hold_what_a_ray_says() -> None:
    l_shape = polygon("0,0 4,0 4,1 1,1 1,4 0,4")
    inside = [(0.5, 0.5), (3.5, 0.5), (0.5, 3.5), (0.0, 0.0), (4.0, 1.0), (1.0, 2.0), (2.0, 1.0)]
    outside = [(2.0, 2.0), (-0.1, 0.5), (4.1, 0.5), (0.5, 4.1), (5.0, 0.0), (-1.0, 1.0), (1.1, 1.1)]
    assert l_shape.holds(np.array(inside)).tolist() == [True] * 7
    assert l_shape.holds(np.array(outside)).tolist() == [False] * 7
    assert box("-1,-2,3,4").holds(np.array([[-1.0, 4.0], [3.1, 0.0]])).tolist() == [True, False]


@given(metres, metres, angles)
@settings(max_examples=40, deadline=None)
def test_turning_there_and_back_is_no_change(x: float, y: float, theta: float) -> None:
    whole, motion = content(60), np.array([x, y, theta])
    there = moved(whole, motion)
    assert np.allclose(there.landmarks.xy_map_m, transform(motion, whole.landmarks.xy_map_m), atol=1e-9)
    back = moved(there, inverse(motion))
    for a, b in ((back.landmarks.xy_map_m, whole.landmarks.xy_map_m), (back.landmarks.cov_m2, whole.landmarks.cov_m2)):
        assert np.allclose(a, b, rtol=0.0, atol=1e-9)
    assert np.allclose(back.key_poses[0].pose, whole.key_poses[0].pose, rtol=0.0, atol=1e-9)
    assert np.allclose(seen_from(there), transform(motion, seen_from(whole)), rtol=0.0, atol=1e-8), "poses turn with it"
    assert back.axis_rad == pytest.approx(whole.axis_rad, abs=1e-9)


def test_covariances_turn() -> None:
    one = replace(landmarks(1), cov_m2=np.diag([4.0, 1.0])[None])
    turned = moved(MapContent.of(one, 0.0), turn_about(np.zeros(2), np.pi / 2)).landmarks
    assert np.allclose(turned.cov_m2[0], np.diag([1.0, 4.0]))


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 180.0, -100.0])
def test_a_robot_sees_the_same_types_on_a_map_that_was_turned(angle_deg: float) -> None:
    """What it sees is named by the axes of its own view, turned to the map's as association does it."""
    whole, angle = content(100), float(np.radians(angle_deg))
    turned = moved(whole, turn_about(np.array([3.0, 4.0]), angle))
    psi_rad, heading_rad = 0.1, 0.14
    seen = turned_type(whole.landmarks.crossing_type, -quarter_turns(psi_rad + heading_rad, whole.axis_rad))
    again = turned_type(seen, quarter_turns(psi_rad + heading_rad + angle, turned.axis_rad))
    assert again.tolist() == turned.landmarks.crossing_type.tolist()


@given(metres, metres, angles, st.floats(1.0, 80.0), angles)
@settings(max_examples=60, deadline=None)
def test_two_marks_are_exact_where_their_distance_is_right(
    x: float, y: float, theta: float, apart: float, towards: float
) -> None:
    motion = np.array([x, y, theta])
    here = np.array([[3.0, -2.0], [3.0 + apart * np.cos(towards), -2.0 + apart * np.sin(towards)]])
    there = transform(motion, here)
    found, longer = alignment(*(Mark(a, b) for a, b in zip(here, there, strict=True)))
    assert np.allclose(transform(found, here), there, rtol=0.0, atol=1e-9) and abs(longer) < 1e-9
    assert np.allclose(compose(found, inverse(motion)), np.zeros(3), atol=1e-9)


def test_what_is_left_of_two_marks_is_shared() -> None:
    found, longer = alignment(mark("0,0=10,5"), mark("30,0=10,35.2"))
    assert longer == pytest.approx(0.2) and np.degrees(found[2]) == pytest.approx(90.0)
    there = transform(found, np.array([[0.0, 0.0], [30.0, 0.0]]))
    assert np.allclose(there, [[10.0, 5.1], [10.0, 35.1]], rtol=0.0, atol=1e-12), "half of it each"
    with pytest.raises(CeilvoError, match=r"--mark: the marks are 0\.100 m apart in the map and 3\.000 m on the plan"):
        alignment(mark("0,0=0,0"), mark("0.1,0=3,0"))


@pytest.mark.parametrize(
    ("kind", "text", "said"),
    [
        (box, "1,2,3", "3 numbers, expected x0,y0,x1,y1"),
        (box, "3,0,1,9", "expected x0,y0,x1,y1 with x0 below x1"),
        (box, "0,0,nan,1", "'nan': expected a number"),
        (box, "0,0,1e9,1", "expected m within 1e\\+06"),
        (polygon, "0,0 1,1", "2 corners, expected 3 or more"),
        (polygon, "0,0 1,1 x,2", "'x': expected a number"),
        (mark, "0,0", "expected x,y=X,Y"),
    ],
)
def test_what_is_no_region_is_one_clear_line(kind: type, text: str, said: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=said):
        kind(text)


def pair(count: int = 200, seed: int = 2) -> tuple[MapContent, MapContent]:
    """Two maps of one ceiling of distinct landmarks, each with errors that its covariances tell of."""
    rng = np.random.default_rng(seed)
    at = np.column_stack([1.2 * (np.arange(count) % 20), 1.2 * (np.arange(count) // 20)])
    kinds = rng.integers(0, 13, count)
    kinds[kinds == 9] = 4
    made = []
    for ids, which in ((np.arange(count), np.arange(count) < 150), (5000 + np.arange(count), np.arange(count) >= 50)):
        cov = covariances(rng, count)
        off = np.array([rng.multivariate_normal(np.zeros(2), c) for c in cov])
        m = Landmarks(ids, at + off, cov, kinds, np.full(count, 3), np.full(count, 4)).of(which)
        made.append(MapContent.of(m, 0.1, 100.0))
    return made[0], made[1]


def test_merging_fuses_what_both_know() -> None:
    a, b = pair()
    b = replace(b, sessions=(Session("b", 1.0, 2.0),), seen_s=b.seen_s + 50.0)
    both, m = merged(a, b)
    assert m.only_b.size + m.b.size == len(b.landmarks) and 90 <= len(m.b) <= 100, "99 % of 100 are within the gate"
    assert np.all(m.chi2 <= GATE_CHI2) and np.all(b.landmarks.ids[m.b] - 5000 == a.landmarks.ids[m.a])
    assert len(both.landmarks) == len(a.landmarks) + len(m.only_b)
    i = int(m.a[0])
    j = int(m.b[0])
    information = np.linalg.inv(a.landmarks.cov_m2[i]) + np.linalg.inv(b.landmarks.cov_m2[j])
    k = int(np.searchsorted(both.landmarks.ids, a.landmarks.ids[i]))
    assert np.allclose(both.landmarks.cov_m2[k], np.linalg.inv(information), rtol=1e-9)
    weighted = np.linalg.solve(a.landmarks.cov_m2[i], a.landmarks.xy_map_m[i])
    weighted += np.linalg.solve(b.landmarks.cov_m2[j], b.landmarks.xy_map_m[j])
    assert np.allclose(both.landmarks.xy_map_m[k], np.linalg.solve(information, weighted), atol=1e-9)
    assert both.landmarks.sightings[k] == 6 and both.seen_s[k].tolist() == [100.0, 150.0]
    assert [s.name for s in both.sessions] == ["b"]


def test_merging_takes_axes_that_are_named_otherwise() -> None:
    a, b = pair()
    plain, m = merged(a, b)
    other = replace(
        b,
        axis_rad=b.axis_rad + np.pi / 2,
        landmarks=replace(b.landmarks, crossing_type=turned_type(b.landmarks.crossing_type, 1)),
    )
    both, n = merged(a, other)
    assert np.array_equal(both.landmarks.crossing_type, plain.landmarks.crossing_type) and len(n.b) == len(m.b)
    with pytest.raises(CeilvoError, match=r"the axes of the maps are 20\.0 deg apart, expected 5 or less in one frame"):
        merged(a, moved(b, turn_about(np.zeros(2), np.radians(20.0))))


def test_merging_a_map_with_ids_that_are_taken_keeps_its_key_poses_right() -> None:
    a = content(100, seed=1)
    far = moved(content(100, seed=2), np.array([100.0, 0.0, 0.0]))
    renamed = replace(far, key_poses=(replace(far.key_poses[0], session="x"),), sessions=(Session("x", 0.0, 0.0),))
    both, m = merged(a, renamed)
    assert len(m.b) == 0 and len(np.unique(both.landmarks.ids)) == 200
    theirs, now = renamed.key_poses[0].landmark, both.key_poses[1].landmark
    at = dict(zip(renamed.landmarks.ids.tolist(), renamed.landmarks.xy_map_m.tolist(), strict=True))
    then = dict(zip(both.landmarks.ids.tolist(), both.landmarks.xy_map_m.tolist(), strict=True))
    known = [(i, j) for i, j in zip(theirs.tolist(), now.tolist(), strict=True) if i in at]
    assert len(known) > 10 and all(at[i] == then[j] for i, j in known)
    again, _ = merged(both, renamed)
    assert [s.name for s in again.sessions] == ["hall-3/a", "hall-3/b", "x"] and len(again.key_poses) == 2


def test_a_map_merged_with_itself_gains_no_landmarks() -> None:
    whole, _ = pair()
    both, m = merged(whole, whole)
    assert len(m.only_b) == 0 and np.allclose(both.landmarks.xy_map_m, whole.landmarks.xy_map_m, atol=1e-12)


def test_known_changes_are_found() -> None:
    a, _ = pair()
    n = len(a.landmarks)
    xy = a.landmarks.xy_map_m.copy()
    xy[:7] += 0.2
    changed = replace(a.landmarks, xy_map_m=xy).of(np.arange(n) >= 3)
    extra = replace(landmarks(5), ids=9000 + np.arange(5), xy_map_m=np.full((5, 2), 500.0) + np.arange(5)[:, None])
    b = Landmarks(*(np.concatenate([getattr(changed, f), getattr(extra, f)]) for f in Landmarks.__dataclass_fields__))
    assert have_same_ids(a.landmarks, b)
    m = matches_by_id(a.landmarks, b)
    assert (len(m.only_a), len(m.only_b), int(m.moved(3.0).sum())) == (3, 5, 4)
    strangers = replace(b, ids=b.ids + 10**6)
    assert not have_same_ids(a.landmarks, strangers)
    p = matches_by_place(a.landmarks, strangers)
    assert (len(p.only_a), len(p.only_b), int(p.moved(3.0).sum())) == (3, 5, 4)


def test_moving_a_map_changes_a_copy() -> None:
    whole = content(50)
    moved(whole, np.array([1.0, 2.0, 3.0]))
    merged(whole, whole)
    without(whole, box("0,0,9,9").holds)
    assert same_content(whole, content(50))
    assert np.allclose(rotation(0.0), np.eye(2))
