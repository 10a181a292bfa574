"""A robot that is sure of its place in a room of 5 m whose map it was given, through the daemon's own path."""

from __future__ import annotations

import numpy as np

from ceilvo.bench.place.case import drive_in, load_known
from ceilvo.bench.place.ceiling.worlds import World, WorldSpec, make_world
from ceilvo.bench.place.robot.drive import Drive
from ceilvo.bench.place.robot.sights import CrossingSight


def in_known_room(seed: int, number: int, wheels: bool) -> tuple[Drive, CrossingSight, World]:
    """After 10 s of driving at 10 Hz; the seeds of rooms, and which of them."""
    rng = np.random.default_rng([seed, number])
    world = make_world(WorldSpec("5", 0.6, "raster", seed + number))
    drive = drive_in(world, rng, wheels, 10.0, True, 0.5)
    load_known(drive, world, rng)
    assert drive.settle(30.0)
    drive.go(10.0)
    assert isinstance(drive.camera, CrossingSight)
    return drive, drive.camera, world
