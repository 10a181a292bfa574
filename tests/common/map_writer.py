"""A process that saves a map and a state as fast as it can, to be killed; started from one that has all modules."""

from __future__ import annotations

from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ceilvo.daemon.map.kept.store import Store
from ceilvo.types import Displacement, Estimate, FilterHealth, Landmarks, Motion, Pose, State, Twist

LANDMARKS = 400
SAVES_A_WORD = 4


def landmarks(count: int) -> Landmarks:
    i = np.arange(count)
    xy = np.column_stack([0.6 * (i % 20), 0.6 * (i // 20)])
    return Landmarks(i, xy, np.tile(1e-4 * np.eye(2), (count, 1, 1)), i % 9, np.full(count, 3))


def estimate(n: int) -> Estimate:
    return Estimate(
        seq=n,
        stamp_ns=n,
        pose=Pose(np.array([0.001 * n, 2.0, 0.5])),
        cov=np.diag([1e-4, 1e-4, 1e-6]),
        odom=Pose(np.zeros(3)),
        twist=Twist(np.zeros(3)),
        state=State.TRACKING,
        quality=0.9,
        reason="",
        motion=Motion(Displacement(np.zeros(3)), np.eye(3), 0, 0.0),
        health=FilterHealth(0, 0.0, 0, 0.0, 0.0, 0),
        crossings=0,
        landmarks=0,
    )


def write(folder: Path, to: Connection) -> None:
    store = Store(folder)
    loaded = store.load()
    n = 0 if loaded is None or loaded.state is None else int(loaded.state.stamp_ns)
    to.send((n, len(list(folder.iterdir()))))
    while True:
        n += 1
        assert store.save(landmarks(LANDMARKS), 0.25, estimate(n))
        if n % SAVES_A_WORD == 0:
            to.send("saved")
