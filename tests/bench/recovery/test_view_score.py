"""How well a map explains a view."""

import numpy as np

from ceilvo.bench.recovery.view_score import explained
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.types import Landmarks, Observations


def test_explained_features_are_counted_by_type_at_every_shift() -> None:
    xy = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    landmarks = Landmarks(np.arange(3), xy, np.tile(np.eye(2), (3, 1, 1)), np.array([4, 4, 2]), np.ones(3, np.int64))
    pose = np.array([2.0, 3.0, 0.5 * np.pi])
    seen = (xy + np.array([0.6, 0.0]) - pose[:2]) @ np.array([[0.0, -1.0], [1.0, 0.0]])  # as from 0.6 m further on
    o = Observations(seen, np.ones((3, 2)), np.array([4, 4, 8]), np.full(3, -1), 0.0, 1.0, 0.0)
    poses = np.tile(pose, (3, 1))
    poses[:, 0] += [0.0, -0.6, 0.4]
    counts = explained(IndexedMap(landmarks), poses, o, 0.2)
    assert counts.tolist() == [0.0, 2.0, 1.0]
