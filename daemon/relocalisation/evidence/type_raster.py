"""Which types of features are near a point: pictures to look into, of a map's part or of a view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation import kernel
from ceilvo.daemon.relocalisation.kernel.arguments import Raster
from ceilvo.types import Array, Ints

REACH_M = 0.05
"""A feature so near a landmark of its type is that landmark. Measured at the truth, ten drives in rooms of 5 and 20 m
(seeds 110 to 151): of 48,000 features with one in 0.13 m all but 1 in 200 were within 0.01 m, and all but 1 in 1500
within 0.05 m; the rest is for rocking and for maps that are bent. Of lamps at wrong places most lie 0.1 m off."""
CELL_M = 0.025
"""Side of a cell of the pictures that are looked into; chosen: 0.0125 m more or less of REACH_M."""
VISIBLE, RARE = np.uint16(1 << 15), np.uint16(1 << 14)
"""Bits above those of the types, see TypeRaster."""


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
        own = np.left_shift(1, crossing_type) if named is None else np.where(named, np.left_shift(1, crossing_type), 0)
        bits = np.zeros(shape, np.uint16)
        what = own.astype(np.uint16) | np.where(rare[crossing_type], RARE, np.uint16(0))
        kernel.stamped(bits, np.floor(xy_m / CELL_M).astype(np.int64) - low, what, np.asarray(disc, np.uint8))
        if corners_m is not None and len(corners_m) > 2:
            seen = np.zeros(shape, np.uint8)
            cv2.fillConvexPoly(seen, np.round(corners_m / CELL_M - 0.5 - low).astype(np.int32), 1)
            bits |= seen * VISIBLE
        return TypeRaster(low, bits)

    def at(self, xy_m: Array) -> NDArray[np.uint16]:
        """(...,) bits at points (..., 2)."""
        bits: NDArray[np.uint16] = kernel.looked_up(self.picture, xy_m.reshape(-1, 2))
        return bits.reshape(xy_m.shape[:-1])

    @property
    def picture(self) -> Raster:
        return Raster(self.low, self.cells, CELL_M)
