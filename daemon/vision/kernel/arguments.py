"""What the loops over edge points are given, and what of it does not fit together; the same for both versions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]
Int16s = NDArray[np.int16]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]
Bools = NDArray[np.bool_]
Ends = tuple[int, int, int, int, int]
"""Bounds of the four groups of points: 0, then where each ends."""

LOOKUP_STEP_PX = 2
"""Spacing of the look-up: a lens bends by thousandths of a pixel over so little."""

SEGMENT_PX = 16.0
"""A predicted edge is straight in the raw picture over so much of it."""

MOST_PLACES = 1_000_000
"""A line along which as many places would be looked at is left out; chosen: no picture is as wide."""


class Grids(NamedTuple):
    """A camera's look-ups from raw to level pixels and back; level pixels count from the principal point.

    Attributes:
        lookup: (rows, columns, 2) level pixel of every LOOKUP_STEP_PX-th raw one.
        raw_of_level: (rows, columns, 2) raw pixel of every cell_px-th level one, the first at low_px; nan outside.
    """

    lookup: Array32
    raw_of_level: Array32
    low_px: tuple[float, float]
    cell_px: float


class Look(NamedTuple):
    """How to look for an edge: every stride_px along it, within reach_px of where it should be.

    Attributes:
        floor: least magnitude of the gradient.
        gate: least cosine between the gradient and the edge's normal.
        strongest: take the strongest within reach, else the nearest.
    """

    stride_px: float
    reach_px: float
    floor: float
    gate: float
    strongest: bool


class Step(NamedTuple):
    """How one step of the joint least squares is weighed.

    Attributes:
        correlated: points that share one error.
        least_noise_px: standard deviation of points at the least.
        direction_info, tilt_info: inverse variances beforehand, rad^-2.
        held: the tilt stays where it is.
    """

    focal_px: float
    correlated: float
    least_noise_px: float
    direction_info: float
    tilt_info: float
    held: bool


class Widths(NamedTuple):
    """Edges of one polarity closer than same_px are one; of two, closer than groove_px, the sides of a groove; gaps
    below narrow_px count alike."""

    same_px: float
    groove_px: float
    narrow_px: float


class Arm(NamedTuple):
    """A line reaches a crossing where, of the bins between corner_px beyond and reach_px before it, so many as `need`
    hold a point."""

    reach_px: float
    corner_px: float
    bin_px: float
    need: float


def check_length(name: str, found: int, expected: int) -> None:
    if found != expected:
        raise ValueError(f"{name} has {found} items, expected {expected}")


def check_lookup(lookup: tuple[int, ...], picture: tuple[int, int]) -> None:
    """ValueError unless all four corners about every pixel are there; the picture's border is never looked up.

    Args:
        lookup: its shape.
        picture: height and width.
    """
    need = tuple((size - 2) // LOOKUP_STEP_PX + 2 for size in picture)
    if lookup[0] < need[0] or lookup[1] < need[1]:
        found, wanted = f"{lookup[0]} x {lookup[1]}", f"{need[0]} x {need[1]}"
        raise ValueError(f"look-up of {found} cells for {picture[0]} x {picture[1]} pixels, expected {wanted} or more")


def check_rows(rows: tuple[int, ...] | None, height: int) -> None:
    """ValueError unless a table of a rolling shutter's rows has every row of the picture, and one more.

    Args:
        rows: its shape, None where there is none.
    """
    if rows is not None and rows != (height + 1, 4):
        raise ValueError(f"rows of {' x '.join(map(str, rows))} numbers, expected {height + 1} x 4")


def check_search(grids: Grids, look: Look, picture: tuple[int, int]) -> None:
    """ValueError unless edges can be followed in a picture of this height and width."""
    check_lookup(grids.lookup.shape, picture)
    rows, columns = grids.raw_of_level.shape[:2]
    if min(picture) < 3 or min(rows, columns) < 2 or not look.stride_px > 0.0:
        raise ValueError(
            f"picture of {picture[0]} x {picture[1]} pixels, raw_of_level of {rows} x {columns} cells, stride of "
            f"{look.stride_px} px; expected at least 3 x 3, 2 x 2 and a stride above 0"
        )
