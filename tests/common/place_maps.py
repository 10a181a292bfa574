"""Maps to look for places on, views of them, and the truth about both by brute force."""

from __future__ import annotations

import numpy as np

from ceilvo.crossing_types import turned_type
from ceilvo.se2 import inverse, rotation, transform, wrap, wrap_array
from ceilvo.types import UNLABELLED, Array, Ints, Landmarks, Observations

CORNERS = (0, 2, 6, 8)
"""Types of a lamp's corners; a quarter turn takes each to another."""
JOINT = 4
"""Type of a crossing of two grooves, the same after any quarter turn."""
SQUARE = 1.5 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""(4, 2) corners of what a view of 3 m shows."""


def map_of(xy: Array, kind: Ints, first_id: int = 0) -> Landmarks:
    n = len(xy)
    cov = np.tile(1e-6 * np.eye(2), (n, 1, 1))
    return Landmarks(
        first_id + np.arange(n), np.reshape(xy, (n, 2)).astype(float), cov, np.asarray(kind), np.full(n, 9)
    )


def random_map(rng: np.random.Generator, count: int, side_m: float, kinds: tuple[int, ...] = CORNERS) -> Landmarks:
    """Landmarks anywhere in a square around the origin."""
    return map_of(rng.uniform(-0.5 * side_m, 0.5 * side_m, (count, 2)), rng.choice(kinds, count))


def tiles(width: int, height: int, tile_m: float, lamps: Ints) -> Landmarks:
    """Joints of width x height tiles from the origin, and lamps (N, 2) of one tile each, by their place in tiles."""
    joints = tile_m * np.stack(np.meshgrid(np.arange(width + 1), np.arange(height + 1), indexing="ij"), -1).reshape(
        -1, 2
    )
    corner = np.array([[0.04, 0.04], [0.04, tile_m - 0.04], [tile_m - 0.04, 0.04], [tile_m - 0.04, tile_m - 0.04]])
    xy = (tile_m * np.reshape(lamps, (-1, 1, 2)) + corner).reshape(-1, 2)
    kind = np.concatenate([np.full(len(joints), JOINT), np.tile([8, 6, 2, 0], len(xy) // 4)])
    return map_of(np.concatenate([joints, xy]), kind)


def ceiling(seed: int, raster: bool = False) -> Landmarks:
    """10.8 m square, tiles of 0.6 m; one in five is a lamp of four corners, at random or every fourth by third."""
    rng = np.random.default_rng(seed)
    xy, kinds = [], []
    for i in range(18):
        for j in range(18):
            xy.append((0.6 * i, 0.6 * j))
            kinds.append(4)
            if (i % 4 == 0 and j % 3 == 0) if raster else rng.random() < 0.2:
                for dx, dy, kind in ((0.1, 0.1, 0), (0.5, 0.1, 2), (0.1, 0.5, 6), (0.5, 0.5, 8)):
                    xy.append((0.6 * i + dx, 0.6 * j + dy))
                    kinds.append(kind)
    n = len(xy)
    seen = np.full(n, 50)
    return Landmarks(np.arange(n), np.array(xy), np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.array(kinds), seen)


def view_of(
    landmarks: Landmarks,
    pose: Array,
    rng: np.random.Generator,
    turns: int = 0,
    noise_m: float = 0.005,
    half_m: tuple[float, float] = (1.6, 1.2),
    keep: float = 1.0,
    extra: int = 0,
) -> Observations:
    """What is in a rectangle around the robot, with the heading named `turns` quarter turns further.

    Args:
        keep: fraction of the landmarks that is seen.
        extra: features that are no landmarks.
    """
    at = transform(inverse(np.asarray(pose, float)), landmarks.xy_map_m)
    seen = np.flatnonzero(np.all(np.abs(at) < half_m, axis=1) & (rng.random(len(at)) < keep))
    xy = np.concatenate([at[seen], rng.uniform(-1.0, 1.0, (extra, 2)) * half_m])
    kind = np.concatenate([landmarks.crossing_type[seen], rng.choice(landmarks.crossing_type, extra)])
    xy = xy + noise_m * rng.standard_normal(xy.shape)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(half_m)
    label, var = np.full(len(xy), UNLABELLED), np.full(xy.shape, max(noise_m, 1e-4) ** 2)
    heading = wrap(float(pose[2]) + 0.5 * np.pi * turns)
    return Observations(xy, var, turned_type(kind, -turns % 4), label, heading, 1e-4, 0.0, corners)


def at_heading(view: Observations, heading_rad: float) -> tuple[Array, Ints]:
    """Features along the map's axes (K, 2), and their types there (K,), for a heading a quarter turn or more off."""
    turns = round((view.heading_rad - heading_rad) / (0.5 * np.pi)) % 4
    return view.xy_base_m @ rotation(heading_rad).T, turned_type(view.crossing_type, turns)


def nearest(landmarks: Landmarks, xy: Array, kind: Ints | None) -> Array:
    """(...,) distance of points (..., 2) to the nearest landmark, of their type (...,) if given; all are compared."""
    off = np.asarray(xy)[..., None, :] - landmarks.xy_map_m
    apart = np.hypot(off[..., 0], off[..., 1])
    if kind is not None:
        apart = np.where(np.asarray(kind)[..., None] == landmarks.crossing_type, apart, np.inf)
    return np.asarray(np.min(apart, axis=-1, initial=np.inf))


def explained(landmarks: Landmarks, poses: Array, view: Observations, reach_m: float) -> Ints:
    """(M,) features with a landmark of their type within reach, from poses (M, 3)."""
    poses, out = np.reshape(poses, (-1, 3)), np.zeros(len(np.reshape(poses, (-1, 3))), np.int64)
    for heading in np.unique(poses[:, 2]):
        which = np.flatnonzero(poses[:, 2] == heading)
        xy, kind = at_heading(view, float(heading))
        for part in np.array_split(which, len(which) // 500 + 1):
            apart = nearest(landmarks, xy + poses[part, None, :2], kind)
            out[part] = np.count_nonzero(apart <= reach_m, axis=1)
    return out


def contradicted(landmarks: Landmarks, pose: Array, view: Observations, reach_m: float, ground_m: float) -> int:
    """Features without one, near any landmark."""
    xy, kind = at_heading(view, float(pose[2]))
    there = nearest(landmarks, xy + pose[:2], kind) <= reach_m
    return int(np.count_nonzero(~there & (nearest(landmarks, xy + pose[:2], None) <= ground_m)))


def missed(landmarks: Landmarks, pose: Array, view: Observations, reach_m: float, inside_m: float) -> int:
    """Landmarks inside of the visible part, so far from its rim, without a feature of their type within reach."""
    base = transform(inverse(pose), landmarks.xy_map_m)
    side = np.roll(view.visible_m, -1, axis=0) - view.visible_m
    off = base[:, None] - view.visible_m
    depth = (side[:, 0] * off[..., 1] - side[:, 1] * off[..., 0]) / np.hypot(*side.T)
    xy, kind = at_heading(view, float(pose[2]))
    seen = map_of(xy + pose[:2], kind)
    there = nearest(seen, landmarks.xy_map_m, landmarks.crossing_type) <= reach_m
    return int(np.count_nonzero(np.all(depth >= inside_m, axis=1) & ~there))


def all_places(landmarks: Landmarks, view: Observations) -> Array:
    """(N, 3) poses that put any feature on any landmark of its type, at the four headings; of those within 1 cm one."""
    out = []
    for turn in range(4):
        heading = wrap(view.heading_rad - 0.5 * np.pi * turn)
        xy, kind = at_heading(view, heading)
        k, m = np.nonzero(kind[:, None] == landmarks.crossing_type)
        out.append(np.column_stack([landmarks.xy_map_m[m] - xy[k], np.full(len(k), heading)]))
    places = np.concatenate(out)
    return np.asarray(places[np.unique(np.round(places, 2), axis=0, return_index=True)[1]])


def off(poses: Array, pose: Array) -> tuple[Array, Array]:
    """(M,) m and rad of poses (M, 3) from one."""
    return np.hypot(*(poses - pose)[:, :2].T), np.abs(wrap_array(poses[:, 2] - pose[2]))


def listed(poses: Array, pose: Array, within_m: float = 0.1) -> bool:
    apart, turned = off(poses, pose)
    return bool(np.any((apart < within_m) & (turned < 0.1)))
