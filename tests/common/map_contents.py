"""Maps with everything in them, made from a seed."""

from __future__ import annotations

import numpy as np

from ceilvo.daemon.map.database.content import MapContent, Session
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.types import Landmarks

KINDS = (*range(9), 10, 11, 12)
MANY = 500


def covariances(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 2, 2) of some millimetres, exactly symmetric."""
    a = rng.normal(0.0, 5e-3, (count, 2, 2))
    cov = a @ np.swapaxes(a, 1, 2) + 1e-6 * np.eye(2)
    return 0.5 * (cov + np.swapaxes(cov, 1, 2))


def landmarks(count: int, seed: int = 1, side_m: float = 20.0) -> Landmarks:
    """Anywhere in a square from the origin, with gaps in their ids; fewer are the first of more."""
    if count < MANY:
        return landmarks(MANY, seed, side_m).of(np.arange(count))
    rng = np.random.default_rng(seed)
    sightings = rng.integers(1, 50, count)
    return Landmarks(
        ids=np.cumsum(rng.integers(1, 4, count)),
        xy_map_m=rng.uniform(0.0, side_m, (count, 2)),
        cov_m2=covariances(rng, count),
        crossing_type=rng.choice(KINDS, count),
        sightings=sightings,
        expected=sightings + rng.integers(0, 9, count),
    )


def key_poses(session: str, count: int, seed: int = 1, side_m: float = 20.0, ids: int = 50) -> KeyPoses:
    """A drive through the square; some views are empty, and the first motion says nothing."""
    rng = np.random.default_rng(seed)
    features = rng.integers(0, 6, count)
    o = int(features.sum())
    cov = np.tile(np.diag([1e-4, 1e-4, 1e-6]), (count, 1, 1))
    cov[:1] = np.diag(np.full(3, np.inf))
    return KeyPoses(
        session=session,
        stamp_ns=1_000_000_000 * (1 + np.arange(count)),
        pose=np.column_stack([rng.uniform(0.0, side_m, (count, 2)), rng.uniform(-3.0, 3.0, count)]),
        motion=rng.normal(0.0, 0.3, (count, 3)),
        motion_cov=cov,
        direction_rad=rng.uniform(-0.7, 0.7, count),
        direction_sigma_rad=np.full(count, 1e-4),
        view=np.repeat(np.arange(count), features),
        xy_base_m=rng.normal(0.0, 0.7, (o, 2)),
        cov_base_m2=covariances(rng, o),
        crossing_type=rng.choice(KINDS, o),
        landmark=rng.integers(-1, ids, o),
    )


def content(count: int = 200, seed: int = 1, floor: str = "") -> MapContent:
    """Landmarks, two sessions, and the key poses of one."""
    m = landmarks(count, seed)
    seen_s = 1.7e9 + np.sort(np.random.default_rng(seed).uniform(0.0, 1e6, (count, 2)), axis=1)
    sessions = (Session("hall-3/a", 1.7e9, 1.7e9 + 60.0, 6), Session("hall-3/b", 1.8e9, 1.8e9 + 9.0, 1))
    return MapContent(m, seen_s, 0.25, (key_poses("hall-3/a", 30, seed),), sessions, floor)


def same_landmarks(a: Landmarks, b: Landmarks) -> bool:
    """To the last bit, but for the sign of zero."""
    names = ("ids", "xy_map_m", "cov_m2", "crossing_type", "sightings", "expected")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


def same_key_poses(a: KeyPoses, b: KeyPoses) -> bool:
    names = [n for n in KeyPoses.__dataclass_fields__ if n != "session"]
    return a.session == b.session and all(np.array_equal(getattr(a, n), getattr(b, n)) for n in names)


def same_content(a: MapContent, b: MapContent) -> bool:
    """Everything but the floor's name."""
    return (
        same_landmarks(a.landmarks, b.landmarks)
        and np.array_equal(a.seen_s, b.seen_s)
        and (a.axis_rad, a.sessions) == (b.axis_rad, b.sessions)
        and len(a.key_poses) == len(b.key_poses)
        and all(same_key_poses(*pair) for pair in zip(a.key_poses, b.key_poses, strict=True))
    )
