"""Which types of features are near a point: pictures to look into, of a map's part or of a view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES
from ceilvo.types import Array, Ints

REACH_M = 0.05
"""A feature so near a landmark of its type is that landmark. Measured at the truth, ten drives in rooms of 5 and 20 m
(seeds 110 to 151): of 48,000 features with one in 0.13 m all but 1 in 200 were within 0.01 m, and all but 1 in 1500
within 0.05 m; the rest is for rocking and for maps that are bent. Of lamps at wrong places most lie 0.1 m off."""
CELL_M = 0.025
"""Side of a cell of the pictures that are looked into; chosen: 0.0125 m more or less of REACH_M."""
VISIBLE, RARE = np.uint16(1 << 15), np.uint16(1 << 14)
"""Bits above those of the types, see TypeRaster."""


def _bits(pictures: list[NDArray[np.uint8]]) -> NDArray[np.uint16]:
    out = np.zeros(pictures[0].shape, np.uint16)
    for bit, picture in enumerate(pictures):
        out |= picture.astype(np.uint16) << np.uint16(bit)
    return out


@dataclass(frozen=True, slots=True)
class TypeRaster:
    """For every cell of a box the types that lie within REACH_M, as bits; outside of the box there is nothing.

    Bit 14: a point of a rare type does; bit 15: the cell is in a region.
    """

    low: Ints
    cells: NDArray[np.uint16]

    @staticmethod
    def of(
        xy_m: Array,
        crossing_type: Ints,
        rare: NDArray[np.bool_],
        named: NDArray[np.bool_] | None = None,
        corners_m: Array | None = None,
    ) -> TypeRaster:
        """Of points (L, 2) with their types (L,).

        Args:
            rare: (9,) types that are.
            named: (L,) points that count as of their types, else all; the others only say that something is there.
            corners_m: (V, 2) of a convex region.
        """
        pad = int(np.ceil(REACH_M / CELL_M)) + 1
        everything = xy_m if corners_m is None else np.concatenate([xy_m, corners_m])
        if not len(everything):
            return TypeRaster(np.zeros(2, np.int64), np.zeros((1, 1), np.uint16))
        low = np.floor(np.min(everything, axis=0) / CELL_M).astype(np.int64) - pad
        high = np.floor(np.max(everything, axis=0) / CELL_M).astype(np.int64) + pad
        shape = tuple((high - low + 1)[::-1])
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pad - 1, 2 * pad - 1))
        column, row = (np.floor(xy_m / CELL_M).astype(np.int64) - low).T
        pictures = [np.zeros(shape, np.uint8) for _ in range(CROSSING_TYPES)]
        any_rare = np.zeros(shape, np.uint8)
        for t in np.unique(crossing_type):
            of = crossing_type == t
            if rare[t]:
                any_rare[row[of], column[of]] = 1
            of &= True if named is None else named
            pictures[t][row[of], column[of]] = 1
            pictures[t] = np.asarray(cv2.dilate(pictures[t], disc), np.uint8)
        bits = _bits(pictures) | np.asarray(cv2.dilate(any_rare, disc), np.uint8) * RARE
        if corners_m is not None and len(corners_m) > 2:
            seen = np.zeros(shape, np.uint8)
            cv2.fillConvexPoly(seen, np.round(corners_m / CELL_M - 0.5 - low).astype(np.int32), 1)
            bits |= seen * VISIBLE
        return TypeRaster(low, bits)

    def at(self, xy_m: Array) -> NDArray[np.uint16]:
        """(...,) bits at points (..., 2)."""
        cell = np.floor(xy_m * (1.0 / CELL_M)).astype(np.int64) - self.low
        column, row = cell[..., 0], cell[..., 1]
        height, width = self.cells.shape
        inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
        flat = np.where(inside, row * width + column, 0)
        return np.asarray(np.where(inside, self.cells.reshape(-1)[flat], np.uint16(0)), np.uint16)
