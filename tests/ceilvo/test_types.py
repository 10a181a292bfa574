"""Landmarks: counts and parts of a map."""

from __future__ import annotations

import numpy as np

from ceilvo.types import Landmarks


def landmarks(expected: list[int] | None = None) -> Landmarks:
    counts = {} if expected is None else {"expected": np.array(expected)}
    xy = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])
    cov = np.arange(1.0, 4.0)[:, None, None] * np.eye(2)
    return Landmarks(np.array([7, 8, 9]), xy, cov, np.array([4, 0, 2]), np.array([3, 0, 98]), **counts)


def test_where_nobody_counted_every_landmark_was_seen_whenever_it_was_in_view() -> None:
    assert landmarks().expected.tolist() == [3, 0, 98]
    np.testing.assert_allclose(landmarks().visibility, [4 / 5, 1 / 2, 99 / 100])


def test_visibility_is_what_the_counts_say() -> None:
    np.testing.assert_allclose(landmarks([6, 8, 198]).visibility, [4 / 8, 1 / 10, 99 / 200])
    assert landmarks([1, 8, 198]).expected.tolist() == [3, 8, 198], "seen more often than expected"


def test_a_part_of_a_map_has_every_column() -> None:
    m = landmarks([6, 8, 198])
    for which in (np.array([2, 0]), np.array([True, False, True])):
        part, at = m.of(which), np.arange(3)[which]
        assert part.ids.tolist() == m.ids[at].tolist()
        assert part.crossing_type.tolist() == m.crossing_type[at].tolist()
        assert part.sightings.tolist() == m.sightings[at].tolist()
        assert part.expected.tolist() == m.expected[at].tolist()
        np.testing.assert_array_equal(part.xy_map_m, m.xy_map_m[at])
        np.testing.assert_array_equal(part.cov_m2, m.cov_m2[at])
