"""Things of known place besides the map's landmarks: radio anchors that distances are measured to, and marks."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.types import Array

NAME_CHARS = 40
"""Of an anchor's name; modules have four or sixteen hexadecimal digits."""


@dataclass(frozen=True, slots=True)
class Anchor:
    """A radio anchor, and what is known of the distances to it: they read offset_m + (1 + scale) * distance.

    Attributes:
        name: as the module says it, upper case.
        x_m, y_m: in map; z_m: above the floor.
        sigma_m: of the position, along each axis.
        offset_sigma_m, scale_sigma: standard deviations of offset and scale.
    """

    name: str
    x_m: float
    y_m: float
    z_m: float
    sigma_m: float = 0.05
    offset_m: float = 0.0
    offset_sigma_m: float = 0.15
    scale: float = 0.0
    scale_sigma: float = 0.003


@dataclass(frozen=True, slots=True)
class Mark:
    """A square tag on the ceiling.

    Attributes:
        number: of the tag in its family.
        size_m: side of the black square.
        x_m, y_m, theta_rad: of its middle in map, and of the direction from its first corner to its second: left to
            right of the tag as it is printed.
        sigma_m, sigma_rad: standard deviations of that.
    """

    number: int
    size_m: float
    x_m: float
    y_m: float
    theta_rad: float
    sigma_m: float = 0.01
    sigma_rad: float = 0.01


@dataclass(frozen=True, slots=True)
class Lamp:
    """A lamp, which looks like any other.

    Attributes:
        name: for people.
        x_m, y_m: of the middle of its light, in map; sigma_m: standard deviation of that, along each axis.
        below_m: by how much it hangs below the ceiling.
    """

    name: str
    x_m: float
    y_m: float
    below_m: float = 0.0
    sigma_m: float = 0.02


@dataclass(frozen=True, slots=True)
class Beacons:
    """All that a robot is told of."""

    anchors: tuple[Anchor, ...] = ()
    marks: tuple[Mark, ...] = ()
    lamps: tuple[Lamp, ...] = ()


@dataclass(frozen=True, slots=True)
class Range:
    """A distance in metres to an anchor, as the module said it, at a stamp of CLOCK_MONOTONIC."""

    anchor: str
    stamp_ns: int
    range_m: float


@dataclass(frozen=True, slots=True)
class MarkSeen:
    """A tag in a picture: corners_px (4, 2), raw pixels, from its first corner on, clockwise as it is printed."""

    number: int
    corners_px: Array


@dataclass(frozen=True, slots=True)
class LampSeen:
    """A light in a picture: at_px (2,), raw pixels, the middle of it on the ceiling."""

    at_px: Array
