"""A process that saves into a database of maps as fast as it can, to be killed."""

from __future__ import annotations

from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from map_contents import key_poses, landmarks

from ceilvo.daemon.map.database.copies import keep_copy, open_map
from ceilvo.types import Landmarks

LANDMARKS = 400
COPY_EVERY = 3
"""Saves from one good copy to the next."""


def of_save(n: int) -> Landmarks:
    """What the n-th save writes: it can be told from the content."""
    count = LANDMARKS + n % 50
    base = landmarks(count, seed=1)
    at = np.arange(count) % 10 == n % 10
    seen = np.where(at, 1000 + n, 1)
    return replace(base, ids=np.arange(count), sightings=seen, expected=np.full(count, 10**9 + n))


def write(path: Path, to: Connection) -> None:
    db = open_map(path, create=True)
    stored = db.load()
    n = 0 if stored is None else int(stored.landmarks.expected[0]) - 10**9
    to.send(n)
    while True:
        n += 1
        db.save(of_save(n), 0.25, "a drive", 1.7e9 + n)
        to.send(n)
        if n % COPY_EVERY == 0:
            keep_copy(db)
            db.add_key_poses(replace(key_poses("a drive", 3, n), stamp_ns=10 * n + np.arange(3)), 1.7e9 + n)
