"""A view at one of the four headings that the direction of the ceiling's lines leaves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.crossing_types import turned_type
from ceilvo.daemon.relocalisation.place_index.blocks import CELL_M, FINE_M, Fine, fine
from ceilvo.daemon.relocalisation.place_index.type_grid import Bits
from ceilvo.se2 import rotation, wrap
from ceilvo.types import Array, Ints, Observations

VISIBLE = np.uint16(1 << 15)
"""A bit that no type has: what is here is in view."""


@dataclass(frozen=True, slots=True)
class TurnedView:
    """Features along the map's axes, seen from the robot.

    Attributes:
        heading_rad: of the robot in the map.
        xy: (K, 2) offsets from the robot.
        crossing_type: (K,) in the map's quadrant.
        origin: (2,) cell of expected[0, 0], from the robot.
        expected: (W, H) VISIBLE where a landmark would be seen, and the bits of the types of features within reach;
            (0, 0) where it is not known what is in view.
    """

    heading_rad: float
    xy: Fine
    crossing_type: Ints
    origin: Ints
    expected: Bits

    @staticmethod
    def of(view: Observations, turn: int, reach_m: float) -> TurnedView:
        heading_rad = wrap(view.heading_rad - 0.5 * np.pi * turn)
        turned = rotation(heading_rad).T
        xy, kind = view.xy_base_m @ turned, turned_type(view.crossing_type, turn)
        origin, expected = _expected(xy, kind, view.visible_m @ turned, reach_m)
        return TurnedView(heading_rad, fine(xy), kind, origin, expected)


def _expected(xy: Array, kind: Ints, corners: Array, reach_m: float) -> tuple[Ints, Bits]:
    """The picture of the view, and its first cell; what is within reach of the rim may be out of view."""
    if not len(corners):
        return np.zeros(2, np.int64), np.zeros((0, 0), np.uint16)
    low = np.floor(corners.min(axis=0) / CELL_M).astype(np.int64)
    size = np.floor(corners.max(axis=0) / CELL_M).astype(np.int64) - low + 1
    cell = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1)
    centre = (low + cell + 0.5) * CELL_M
    side = np.roll(corners, -1, axis=0) - corners
    length = np.maximum(np.hypot(*side.T), FINE_M)
    off = centre[:, :, None, :] - corners
    within = np.all((side[:, 0] * off[..., 1] - side[:, 1] * off[..., 0]) / length >= reach_m, axis=-1)
    bits = np.where(within, VISIBLE, np.uint16(0))
    for (fx, fy), t in zip(xy, kind, strict=True):
        near = (centre[..., 0] - fx) ** 2 + (centre[..., 1] - fy) ** 2 <= reach_m**2
        bits[near] |= np.uint16(1 << int(t))
    return low, bits
