"""The senses that a robot of the bench can have, and its outfits. A sense is an entry in a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ceilvo.bench.fusion.beacons import LampsSense, MarksSense, RangesSense
from ceilvo.bench.fusion.devices import GyroSense, WheelsSense
from ceilvo.bench.fusion.robot import Moment
from ceilvo.bench.fusion.said import Said
from ceilvo.bench.place.ceiling.worlds import World
from ceilvo.config import Config
from ceilvo.senses.beacons import Beacons


class Device(Protocol):
    """A sense in one drive, with randomness of its own: outfits with and without it are alike otherwise.

    Attributes:
        beacons: things of known place that the robot is told of.
    """

    @property
    def beacons(self) -> Beacons: ...

    def live(self, moment: Moment) -> None:
        """Every step of the simulation, robot.TICK_S, in order."""

    def tell(self, before_ns: int, stamp_ns: int, said: Said) -> None:
        """Add to what is said of a frame what this sense has of the time since the frame before."""


class Sense(Protocol):
    """An entry of SENSES."""

    def configured(self, config: Config, world: World) -> Config:
        """The configuration with the sense switched on, and all that it must know of the place."""

    def device(self, world: World, config: Config, rng: np.random.Generator) -> Device: ...


SENSES: Mapping[str, Sense] = {
    "wheels": WheelsSense(),
    "gyro": GyroSense(),
    "ranges": RangesSense(),
    "marks": MarksSense(),
    "lamps": LampsSense(),
}
"""By name."""
OUTFITS: Mapping[str, tuple[str, ...]] = {
    "vision": (),
    "+ wheels": ("wheels",),
    "+ gyro": ("wheels", "gyro"),
    "+ ranges": ("wheels", "gyro", "ranges"),
    "+ marks": ("wheels", "gyro", "ranges", "marks"),
    "+ lamps": ("wheels", "gyro", "ranges", "marks", "lamps"),
    "ranges only": ("ranges",),
    "marks only": ("marks",),
    "wheels, lamps": ("wheels", "lamps"),
    "lamps only": ("lamps",),
}
"""What is compared, each with one sense more than the one before; and some without the others."""
