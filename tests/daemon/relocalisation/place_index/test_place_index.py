"""Places found from one view, against the truth that the view was made from."""

import numpy as np
import pytest

from ceilvo.crossing_types import turned_type
from ceilvo.daemon.relocalisation.place_index.place_index import PlaceIndex
from ceilvo.se2 import inverse, transform, wrap
from ceilvo.types import UNLABELLED, Landmarks, Observations


def map_of(xy, kind, first_id=0):
    n = len(xy)
    cov = np.tile(1e-6 * np.eye(2), (n, 1, 1))
    return Landmarks(first_id + np.arange(n), np.asarray(xy, float), cov, np.asarray(kind), np.full(n, 9))


def view_of(landmarks, pose, rng, turns=0, noise_m=0.005, half=(1.6, 1.2)):
    """What is seen from a pose within a rectangle, whose heading is named `turns` quarter turns further."""
    at = transform(inverse(np.asarray(pose)), landmarks.xy_map_m)
    seen = np.flatnonzero(np.all(np.abs(at) < half, axis=1))
    xy = at[seen] + noise_m * rng.standard_normal((len(seen), 2))
    kind = turned_type(landmarks.crossing_type[seen], -turns % 4)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(half)
    heading = wrap(pose[2] + 0.5 * np.pi * turns)
    return Observations(
        xy, np.full((len(seen), 2), noise_m**2), kind, np.full(len(seen), UNLABELLED), heading, 1e-4, 0.0, corners
    )


@pytest.mark.parametrize("turns", range(4))
def test_a_place_is_found_from_one_view_whatever_the_quarter_turn(turns):
    rng = np.random.default_rng(turns)
    known = map_of(rng.uniform(-10, 10, (800, 2)), rng.choice([0, 2, 6, 8], 800))
    index = PlaceIndex.of(known)
    for pose in ([0.0, 0.0, 0.3], [5.0, -4.0, -2.0], [-7.0, 7.0, 3.0]):
        view = view_of(known, pose, rng, turns)
        found = index.candidates(view)
        assert found.complete
        assert found.explained[0] == found.seen == len(view)
        assert found.false_alarm_probability[0] < 1e-3
        off = index.refined(found.pose[:1], view)[0] - pose
        assert np.hypot(*off[:2]) < 0.02
        assert abs(wrap(off[2])) < 0.01
