"""What the loops over landmarks and places are given; the same for both versions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ceilvo.types import Array, Ints

Bools = NDArray[np.bool_]
Bits = NDArray[np.uint16]
Fine = NDArray[np.int32]
"""Coordinates in the map, in 1/256 of a cell."""
Slots = NDArray[np.int32]

END = -1
"""After the last landmark of a block; type of a free slot."""
LINE_FEATURES = 2.0
"""What is missing or mistaken along one line is worth so many of those together, one in all: a line that is missed or
called something else takes all its crossings with it. A wall's edge that was missed once took eleven landmarks along,
and contradicted the map by e^8."""
COVERAGE_SIDE = 32
"""Cells along a block of ground, 8 m; chosen: a view touches one to four."""
COVERAGE_OFFSET = 1 << 20
"""Blocks of ground are numbered from so far below zero; no building is a million blocks wide."""


class Chains(NamedTuple):
    """Landmarks by square blocks, see LandmarkBlocks: there each block has a chain of those that lie in it.

    Attributes:
        origin: (2,) place of number[0, 0] in blocks.
        number: (W, H) numbers of the blocks, 0 where there is none.
        head: (B,) first slot of a block's chain, END for none.
        chain: (S,) the slot after this one.
        xy: (S, 2) where each landmark is.
        crossing_type: (S,).
        shift: coordinates without so many of their last bits are blocks.
    """

    origin: Ints
    number: NDArray[np.int32]
    head: Slots
    chain: Slots
    xy: Fine
    crossing_type: NDArray[np.int8]
    shift: int


class Raster(NamedTuple):
    """A picture (H, W) of bits, the first cell's place (2,), and the side of a cell, m."""

    low: Ints
    cells: Bits
    cell_m: float


class Ground(NamedTuple):
    """Views of ground: (B,) numbers of blocks, rising, (B, 32, 32) views of their cells, and the side of a cell, m."""

    block: Ints
    shown: NDArray[np.uint8]
    cell_m: float


class Ratios(NamedTuple):
    """(V, T, R) log-likelihood ratios of a feature with a landmark of its type, of another, and without any.

    By steps of so many views of the ground and by type; ground is known from so many views on.
    """

    gain: Array
    mistaken: Array
    loss: Array
    views_per_step: int
    known_views: int


def check_length(name: str, found: int, expected: int) -> None:
    if found != expected:
        raise ValueError(f"{name} has {found} items, expected {expected}")
