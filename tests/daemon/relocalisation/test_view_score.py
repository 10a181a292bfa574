"""How well a map explains a view."""

import numpy as np

from ceilvo.daemon.relocalisation.view_score import contradicted, explained
from ceilvo.daemon.slam.spatial_index import IndexedMap
from ceilvo.se2 import inverse, transform
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
