"""What a view says of poses: against ceilings whose every feature is known."""

from dataclasses import replace

import numpy as np
import pytest
from place_maps import SQUARE, ceiling

from ceilvo.crossing_types import CORNER, CROSSING_TYPES, LAMP, turned_type
from ceilvo.daemon.relocalisation.evidence.chance import Chance
from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.daemon.relocalisation.evidence.type_raster import TypeRaster
from ceilvo.daemon.relocalisation.evidence.view_evidence import Surroundings, ViewEvidence
from ceilvo.daemon.relocalisation.evidence.wrong_places import combined
from ceilvo.daemon.relocalisation.place_index.place_index import PlaceIndex
from ceilvo.se2 import inverse, rotation, transform, wrap
from ceilvo.types import Array, Landmarks, Observations

HERE = np.array([5.2, 4.9, 0.3])
ONES = np.ones((2, 1))


def view_from(landmarks: Landmarks, pose: Array, turns: int = 0) -> Observations:
    xy = transform(inverse(pose), landmarks.xy_map_m)
    near = np.all(np.abs(xy) < 1.5, axis=1)
    n = int(near.sum())
    kinds = turned_type(landmarks.crossing_type[near], -turns)
    heading = wrap(float(pose[2]) + 0.5 * np.pi * turns)
    return Observations(xy[near], np.full((n, 2), 1e-5), kinds, np.full(n, -1), heading, 1e-6, 0.0, SQUARE)


def around(landmarks: Landmarks) -> Surroundings:
    same = np.full((2, CROSSING_TYPES), 0.2)
    same[:, 4] = 0.98
    chance = Chance(same, np.minimum(same + 0.1, 0.99))
    return Surroundings.of(landmarks, Coverage.of(landmarks, 0.6), chance, 3.0, 0.0)


def ratio(landmarks: Landmarks, view: Observations, poses: Array) -> Array:
    return combined(ViewEvidence(view, around(landmarks), np.ones(len(view))).log_ratio(poses))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("turns", range(4))
def test_the_true_pose_is_likelier_than_any_whole_tile_or_quarter_turn_off(seed: int, turns: int) -> None:
    landmarks = ceiling(seed)
    view = view_from(landmarks, HERE, turns)
    shifts = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if (i, j) != (0, 0)]
    poses = np.array([HERE, *(HERE + np.array([0.6 * i, 0.6 * j, 0.0]) for i, j in shifts)])
    found = ratio(landmarks, view, poses)
    assert found[0] > 3.0
    assert np.all(found[1:] < found[0] - 6.0)
    assert np.all(
        ratio(landmarks, view, np.array([HERE + np.array([0, 0, q * 0.5 * np.pi]) for q in (1, 2, 3)])) < -5.0
    )


def test_a_bare_grid_says_nothing_and_ground_that_is_not_mapped_says_nothing() -> None:
    landmarks = ceiling(1)
    bare = landmarks.of(landmarks.crossing_type == 4)
    view = view_from(bare, HERE)
    found = ratio(bare, view, np.array([HERE, HERE + np.array([0.6, 0.0, 0.0]), HERE + np.array([-1.2, 0.6, 0.0])]))
    assert np.ptp(found) < 0.3 and np.all(np.abs(found) < 1.0)
    off = ratio(landmarks, view_from(landmarks, HERE), np.array([HERE + np.array([60.0, 0.0, 0.0])]))
    assert abs(off[0]) < 0.2


@pytest.mark.parametrize(("kind", "at_least", "at_most"), [(CORNER, -1.0, 0.1), (4, -9.0, -1.0)])
def test_a_few_new_points_on_ground_that_was_just_mapped_say_little_though_all_are_of_one_type(
    kind: int, at_least: float, at_most: float
) -> None:
    """A detector finds corners of hexagons now and then; a joint between tiles is found from the first view on."""
    landmarks = replace(ceiling(1), crossing_type=np.full(len(ceiling(1)), kind))
    chance = Chance(*(np.where(np.arange(CROSSING_TYPES) == kind, p, 0.2) for p in (0.9 * ONES, 0.95 * ONES)))
    known = Coverage()
    for _ in range(12):
        known.show(transform(HERE, SQUARE))
    view = view_from(landmarks, HERE)
    mapped = landmarks.of(np.flatnonzero(np.arange(len(landmarks)) % 5 > 0))
    around_here = Surroundings.of(mapped, known, chance, 3.0, 0.0)
    found = combined(ViewEvidence(view, around_here, np.ones(len(view))).log_ratio(HERE[None]))[0]
    print(f"type {kind}: {found:.1f} where one feature in five is new")
    assert at_least < found < at_most


def test_a_lamp_that_is_expected_and_not_seen_counts_against_a_pose() -> None:
    landmarks = ceiling(2)
    view = view_from(landmarks, HERE)
    lamp = view.crossing_type != 4
    assert np.count_nonzero(lamp) >= 4
    without = view.of(~lamp)
    assert ratio(landmarks, without, HERE[None])[0] < -3.0
    blind = replace(without, visible_m=np.empty((0, 2)))
    assert abs(ratio(landmarks, blind, HERE[None])[0]) < 0.5


def test_a_point_that_is_not_seen_says_nothing_for_not_every_view_looks_for_points() -> None:
    landmarks = ceiling(2)
    points = replace(landmarks, crossing_type=np.where(landmarks.crossing_type == 4, 4, LAMP))
    view = view_from(points, HERE)
    assert abs(ratio(points, view.of(view.crossing_type == 4), HERE[None])[0]) < 0.5


def test_chances_of_a_recording_that_is_older_than_points_are_widened() -> None:
    older = Chance(np.full((2, 9), 0.1), np.full((2, 9), 0.2))
    assert older.same.shape == older.rare_one.shape == (2, CROSSING_TYPES)


def test_a_third_of_a_ceiling_may_change_and_it_is_still_this_place() -> None:
    landmarks = ceiling(3)
    rng = np.random.default_rng(4)
    moved = landmarks.xy_map_m.copy()
    lamps = np.flatnonzero((landmarks.crossing_type != 4) & (rng.random(len(landmarks)) < 0.3))
    moved[lamps] += 0.3
    view = view_from(Landmarks(landmarks.ids, moved, landmarks.cov_m2, landmarks.crossing_type, landmarks.ids), HERE)
    poses = np.array(
        [
            HERE,
            HERE + np.array([0.6, 0, 0]),
            HERE + np.array([0, -0.6, 0]),
            HERE + np.array([-0.6, 0.6, 0]),
            HERE + np.array([60, 0, 0]),
        ]
    )
    found = ratio(landmarks, view, poses)
    assert np.all(found[0] > found[1:4] + 3.0)


def test_chance_is_measured_on_the_map_itself() -> None:
    for raster, low, high in ((True, 0.7, 1.0), (False, 0.02, 0.5)):
        landmarks = ceiling(5, raster)
        coverage = Coverage.of(landmarks, 0.6)
        rows = TypeRaster.of(landmarks.xy_map_m, landmarks.crossing_type, np.arange(CROSSING_TYPES) != 4)
        shifts = np.array([(0.6 * i, 0.6 * j) for i in range(-6, 7) for j in range(-6, 7) if (i, j) != (0, 0)])
        chance = Chance.measured(landmarks, rows, coverage, shifts)
        assert not chance.rare[4] and np.all(chance.rare_one > chance.same)
        alike = chance.same[1, [0, 2, 6, 8]]
        assert np.all((alike >= low) & (alike <= high)), (raster, alike)
        assert np.allclose(chance.seen_at_wrong_places.sum(axis=1), 1.0)


@pytest.mark.parametrize("turns", [1, 2])
def test_a_ceiling_that_is_alike_once_turned_is_found_to_be(turns: int) -> None:
    """Lamps hung anyhow, and again as seen from the other side: no shift shows that, and a robot was believed there."""
    landmarks = ceiling(5)
    joint = landmarks.crossing_type == 4
    about_m = landmarks.xy_map_m[joint][np.argmin(np.hypot(*(landmarks.xy_map_m[joint] - HERE[:2]).T))]
    off = landmarks.xy_map_m - about_m
    part = landmarks.of(~joint & (off[:, 0] > 0.1) & (np.abs(off[:, 1]) < off[:, 0] if turns == 1 else off[:, 0] > 0.1))
    copies = [part]
    for turn in range(1, 4) if turns == 1 else [2]:
        at = (part.xy_map_m - about_m) @ rotation(0.5 * np.pi * turn).T + about_m
        copies.append(replace(part, xy_map_m=at, crossing_type=turned_type(part.crossing_type, -turn)))
    whole = [landmarks.of(joint), *copies]
    xy, kind = (np.concatenate([getattr(one, name) for one in whole]) for name in ("xy_map_m", "crossing_type"))
    ids = np.arange(len(xy))
    turned = Landmarks(ids, xy, np.tile(1e-6 * np.eye(2), (len(xy), 1, 1)), kind, np.full(len(xy), 20))
    rows, coverage = TypeRaster.of(xy, kind, np.arange(CROSSING_TYPES) != 4), Coverage.of(turned, 0.6)
    shifts = np.array([(0.6 * i, 0.6 * j) for i in range(-6, 7) for j in range(-6, 7) if (i, j) != (0, 0)])
    plain = Chance.measured(turned, rows, coverage, shifts).same[1, [0, 2, 6, 8]]
    found = Chance.measured(turned, rows, coverage, shifts, about_m=about_m).same[1, [0, 2, 6, 8]]
    print(f"{len(part)} rare ones, alike by shifts {plain.round(2)}, by turns as well {found.round(2)}")
    assert np.all(plain < 0.6) and np.all(found > 0.9)


def test_joints_of_a_map_that_is_too_small_to_measure_prove_nothing() -> None:
    """A room of 5 m with tiles of 1.25 m: 0.5 for every type made any other building's joints match."""
    few = ceiling(1).of(np.arange(40))
    chance = Chance.measured(
        few, TypeRaster.of(few.xy_map_m, few.crossing_type, np.ones(9, bool)), Coverage(), np.empty((0, 2))
    )
    assert not chance.rare[4] and np.all(chance.rare[[0, 2, 6, 8]])


def test_a_lamp_a_tenth_of_a_metre_off_is_another_one() -> None:
    landmarks = ceiling(8)
    xy = landmarks.xy_map_m.copy()
    xy[landmarks.crossing_type != 4] += np.array([0.08, 0.06])
    other = replace(landmarks, xy_map_m=xy)
    assert ratio(landmarks, view_from(other, HERE), HERE[None])[0] < -3.0


def test_a_corner_by_another_name_still_counts_for_its_place() -> None:
    landmarks = ceiling(9)
    view = view_from(landmarks, HERE)
    named = view.crossing_type.copy()
    corners = np.flatnonzero(named != 4)
    named[corners[::3]] = np.where(np.isin(named[corners[::3]], (0, 6)), 3, 5)
    mistaken = replace(view, crossing_type=named)
    right, gone = (
        ratio(landmarks, v, HERE[None])[0] for v in (view, view.of(np.delete(np.arange(len(view)), corners[::3])))
    )
    found = ratio(landmarks, mistaken, HERE[None])[0]
    assert gone < found < right


@pytest.mark.parametrize("turns", range(4))
def test_far_places_are_weighed_as_near_ones(turns: int) -> None:
    """What is missing there included: else a true place near by lost to a wrong one far off, view by view."""
    landmarks = ceiling(6)
    view = view_from(landmarks, HERE, turns)
    view = view.of(np.arange(len(view)) % 7 != 3)
    evidence = ViewEvidence(view, around(landmarks), np.ones(len(view)))
    poses = np.array(
        [
            HERE,
            HERE + np.array([0.6, 0.0, 0.0]),
            HERE + np.array([0.0, 0.0, 0.5 * np.pi]),
            HERE + np.array([0.0, 1.2, 0.0]),
        ]
    )
    near, far = (
        combined(evidence.log_ratio(poses)),
        combined(evidence.log_ratio_in(PlaceIndex.of(landmarks).grid, poses)),
    )
    assert np.allclose(near, far, atol=0.3)
    assert np.argmax(far) == 0


def test_what_was_looked_at_before_is_worth_less() -> None:
    landmarks = ceiling(7)
    view = view_from(landmarks, HERE)
    poses = np.array([HERE, HERE + np.array([0.6, 0.0, 0.0])])
    worths = [np.full(len(view), w) for w in (1.0, 0.1)]
    fresh, stale = (ViewEvidence(view, around(landmarks), w).log_ratio(poses) for w in worths)
    any_wrong, alike = ((f[0] - f[1]) / (s[0] - s[1]) for f, s in zip(fresh.T, stale.T, strict=True))
    assert any_wrong > 5.0
    assert 1.5 < alike < any_wrong  # what tells this place from one like it is not all in one view


@pytest.mark.parametrize("seed", range(4))
def test_new_features_at_the_right_place_are_counted_and_then_say_less(seed: int) -> None:
    """The map lacks every third of the odd features that are there."""
    landmarks = ceiling(seed)
    view = view_from(landmarks, HERE)
    odd = np.flatnonzero(landmarks.crossing_type != 4)
    known = landmarks.of(~np.isin(np.arange(len(landmarks)), odd[::3]))
    surroundings, worth = around(known), np.ones(len(view))
    lacked, expected = ViewEvidence(view, surroundings, worth).lacking(HERE)
    whole, _ = ViewEvidence(view, around(landmarks), worth).lacking(HERE)
    poses = np.array([HERE, HERE + np.array([0.6, 0.0, 0.0])])
    usual, wild = (combined(ViewEvidence(view, surroundings, worth, scale).log_ratio(poses)) for scale in (1.0, 4.0))
    print(f"seed {seed}: {lacked:.0f} lacked, {expected:.2f} usual; right and wrong place {usual}, {wild}")
    assert whole == 0.0 < expected
    assert lacked >= 1.0
    assert wild[0] > usual[0]
    assert wild[0] - wild[1] > 3.0, "places are still told apart"
