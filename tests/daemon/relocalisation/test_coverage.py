"""Which ground a map knows."""

import numpy as np

from ceilvo.crossing_types import CORNER, JOINTS, LAMP
from ceilvo.daemon.relocalisation.evidence.coverage import VIEWS, Coverage
from ceilvo.types import Landmarks

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def test_ground_is_known_once_enough_views_have_shown_it() -> None:
    coverage = Coverage()
    points = np.array([[100.0, -50.0], [100.7, -49.3], [101.5, -50.0], [99.2, -50.6]])
    for k in range(VIEWS):
        assert not np.any(coverage.knows(points)), k
        coverage.show(SQUARE + np.array([100.0, -50.0]))
    assert coverage.knows(points).tolist() == [True, True, False, True]
    assert coverage.views(points).tolist() == [VIEWS, VIEWS, 0, VIEWS]
    assert abs(coverage.area_m2 - 4.0) < 1.5
    assert coverage.knows(points.reshape(2, 2, 2)).shape == (2, 2)


def test_ground_is_known_for_the_kinds_of_features_that_its_views_had() -> None:
    coverage = Coverage.of_kinds()
    joints, points = np.array([JOINTS, JOINTS]), np.array([LAMP, CORNER])
    for kinds, times in ((joints, 2 * VIEWS), (points, 3), (np.append(joints, points), VIEWS)):
        for _ in range(times):
            coverage.show(SQUARE, kinds)
    kinds = np.array([JOINTS, CORNER, LAMP, CORNER])
    at = np.array([[0.2, 0.3], [0.2, 0.3], [-0.4, 0.1], [9.0, 9.0]])
    by_kind = [3 * VIEWS, VIEWS + 3, VIEWS + 3, 0]
    assert coverage.views(at, kinds).tolist() == by_kind
    assert coverage.views(at).tolist() == [3 * VIEWS + 3] * 3 + [0]
    assert coverage.views(np.tile(at, (2, 1, 1)), kinds).tolist() == [by_kind] * 2
    for seen, known in ((joints, [1, 0, 0, 0]), (points, [0, 1, 1, 0])):
        alone = Coverage.of_kinds()
        alone.show(SQUARE, seen)
        assert alone.views(at, kinds).tolist() == known
    of_an_old_recording = Coverage(of_points=Coverage())
    of_an_old_recording.show(SQUARE, joints)
    assert of_an_old_recording.views(at, kinds).tolist() == [1, 0, 0, 0]


def test_of_a_map_that_came_without_points_nothing_is_known_for_them() -> None:
    known, at = Coverage.of(tiles(), 0.6), np.array([[3.1, 2.2], [3.1, 2.2]])
    assert known.knows(at, np.array([JOINTS, CORNER])).tolist() == [True, False]
    landmarks = tiles()
    corners = Landmarks(
        landmarks.ids,
        landmarks.xy_map_m,
        landmarks.cov_m2,
        np.full(len(landmarks), CORNER),
        np.full(len(landmarks), 20),
    )
    of_corners = Coverage.of(corners, 0.0)
    assert of_corners.knows(corners.xy_map_m, corners.crossing_type).all()
    assert not of_corners.knows(landmarks.xy_map_m, landmarks.crossing_type).any()


def test_blocks_are_kept_apart_however_far_they_are() -> None:
    coverage = Coverage()
    for x in (-3000.0, 7.9, 4000.0, -8.1):
        for _ in range(300):
            coverage.show(SQUARE + np.array([x, x]))
    at = np.array([[-3000.0, -3000.0], [7.9, 7.9], [4000.0, 4000.0], [-8.1, -8.1], [50.0, 50.0]])
    assert coverage.views(at).tolist() == [255, 255, 255, 255, 0]
    assert np.all(np.diff(coverage.block) > 0)


def tiles(missing: tuple[float, float] | None = None) -> Landmarks:
    xy = 0.6 * np.array([(i, j) for i in range(12) for j in range(8)], float)
    if missing is not None:
        xy = xy[np.hypot(*(xy - missing).T) > 1.4]
    n = len(xy)
    return Landmarks(np.arange(n), xy, np.tile(np.eye(2), (n, 1, 1)), np.full(n, 4), np.full(n, 20))


def test_of_a_map_that_came_without_the_ground_between_landmarks_is_known_and_none_outside() -> None:
    coverage = Coverage.of(tiles(), 0.6)
    rng = np.random.default_rng(3)
    inside = rng.uniform([0.5, 0.5], [6.1, 3.7], (500, 2))
    assert np.all(coverage.knows(inside))
    around = np.concatenate(
        [
            inside + np.array([7.2, 0.0]),
            inside - np.array([7.2, 0.0]),
            inside + np.array([0.0, 4.8]),
            inside - np.array([0.0, 4.8]),
        ]
    )
    outside = np.any((around < -0.3) | (around > [6.9, 4.5]), axis=1)
    assert not np.any(coverage.knows(around[outside]))
    hole = Coverage.of(tiles((3.0, 2.4)), 0.6)
    assert not hole.knows(np.array([3.0, 2.4]))
    assert not np.any(Coverage.of(tiles().of(np.arange(0)), 0.6).knows(inside))


def shifted(m: Landmarks, by: tuple[float, float]) -> Landmarks:
    return Landmarks(m.ids, m.xy_map_m + by, m.cov_m2, m.crossing_type, m.sightings)


def both(a: Landmarks, b: Landmarks) -> Landmarks:
    columns = ("xy_map_m", "cov_m2", "crossing_type", "sightings")
    return Landmarks(np.arange(len(a) + len(b)), *(np.concatenate([getattr(a, c), getattr(b, c)]) for c in columns))


def test_landmarks_that_are_far_apart_cost_no_more_than_near_ones() -> None:
    """The ground between these two would be 10^13 cells."""
    near, far = tiles(), shifted(tiles((3.0, 2.4)), (900_000.0, -700_000.0))
    coverage, alone, other = Coverage.of(both(near, far), 0.6), Coverage.of(near, 0.6), Coverage.of(far, 0.6)
    assert abs(coverage.area_m2 - alone.area_m2 - other.area_m2) < 1e-9
    np.testing.assert_array_equal(coverage.block, np.sort(np.append(alone.block, other.block)))


def test_no_window_shows_in_what_is_known() -> None:
    """A corridor over several windows, and the same one further on."""
    xy = np.array([(0.6 * i, 0.6 * j) for i in range(1200) for j in range(3)])
    n = len(xy)
    corridor = Landmarks(np.arange(n), xy, np.tile(np.eye(2), (n, 1, 1)), np.full(n, 4), np.full(n, 20))
    along = np.column_stack([np.arange(0.3, 719.0, 0.05), np.full(14374, 0.6)])
    for start_m in (0.0, 100.0, 256.0):
        first = tiles().of(np.arange(1))  # windows begin at the map's lowest cells
        known = Coverage.of(both(corridor, shifted(first, (-start_m, -start_m))), 0.6)
        assert np.all(known.knows(along))
        assert not np.any(known.knows(along + np.array([0.0, 3.0])))
