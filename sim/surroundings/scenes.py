"""Rooms whose ceiling has more than one height, for a robot on the usual lap. Heights are metres above the camera."""

from __future__ import annotations

import numpy as np

from ceilvo.sim.surroundings.boxes import Box
from ceilvo.sim.surroundings.surroundings import SurroundingsSpec

_BEYOND_M = 3.0
"""How far all goes on beyond the walls, as the ceiling does; chosen."""
_TILE_ALBEDO = 0.74
"""Of a lower ceiling's tiles; chosen, near the main one's."""
_SHINING, _BOARD = 2.5, 0.5
"""In place of an albedo: a lamp's field, which saturates, and a painted board; chosen."""


def step(room_m: float, ceiling_m: float, down_m: float = 0.4, at: float = 0.5) -> SurroundingsSpec:
    """The part of the room beyond x = at * room_m has a tiled ceiling that is lower."""
    x0, x1, y0, y1 = at * room_m, room_m + _BEYOND_M, -_BEYOND_M, room_m + _BEYOND_M
    low = Box(_middle(x0, x1, y0, y1), (x1 - x0, y1 - y0), ceiling_m - down_m, ceiling_m, _TILE_ALBEDO, 0.6)
    return SurroundingsSpec(boxes=(low,))


def beams(room_m: float, ceiling_m: float, down_m: float = 0.3, every_m: float = 1.6) -> SurroundingsSpec:
    """Beams 0.24 m wide along y, under a tiled ceiling."""
    return SurroundingsSpec(boxes=_row(room_m, ceiling_m, ceiling_m - down_m, 0.24, every_m, 0))


def coffers(room_m: float, ceiling_m: float, down_m: float = 0.25, every_m: float = 1.2) -> SurroundingsSpec:
    """Beams both ways: the ceiling lies in square recesses between them."""
    bottom_m = ceiling_m - down_m
    both = (_row(room_m, ceiling_m, bottom_m, 0.24, every_m, axis) for axis in (0, 1))
    return SurroundingsSpec(boxes=tuple(b for row in both for b in row))


def ducts(room_m: float, ceiling_m: float) -> SurroundingsSpec:
    """Square ducts along y, and higher cable trays along x that they cross, all below the ceiling."""
    along_y = _row(room_m, ceiling_m - 0.15, ceiling_m - 0.55, 0.4, 2.2, 0)
    along_x = _row(room_m, ceiling_m - 0.05, ceiling_m - 0.13, 0.2, 1.7, 1)
    return SurroundingsSpec(boxes=(*along_x, *along_y))


def truss(room_m: float, ceiling_m: float) -> SurroundingsSpec:
    """Thin bars both ways, 0.5 m below the ceiling."""
    both = (
        _row(room_m, ceiling_m - 0.44, ceiling_m - 0.5, 0.06, every_m, axis) for axis, every_m in ((0, 0.9), (1, 1.8))
    )
    return SurroundingsSpec(boxes=tuple(b for row in both for b in row))


def hanging_lamps(room_m: float, ceiling_m: float) -> SurroundingsSpec:
    """Lamps 1.2 m long and 0.15 m wide that shine downwards, 0.6 m below a tiled ceiling."""
    return SurroundingsSpec(boxes=_field(room_m, 1.6, 1.9, (1.2, 0.15), ceiling_m - 0.6, ceiling_m - 0.54, _SHINING))


def signs(room_m: float, ceiling_m: float) -> SurroundingsSpec:
    """Boards 0.9 m wide and 5 cm thick that hang on edge, their lower side 0.45 m below a tiled ceiling."""
    return SurroundingsSpec(boxes=_field(room_m, 2.3, 2.1, (0.9, 0.05), ceiling_m - 0.45, ceiling_m - 0.02, _BOARD))


def _field(
    room_m: float,
    every_x_m: float,
    every_y_m: float,
    size_m: tuple[float, float],
    bottom_m: float,
    top_m: float,
    albedo: float,
) -> tuple[Box, ...]:
    """Boxes all over a room, none in line with the usual tiles."""
    x, y = np.arange(0.5, room_m, every_x_m), np.arange(0.3, room_m, every_y_m)
    return tuple(Box((float(a), float(b)), size_m, bottom_m, top_m, albedo) for a in x for b in y)


def _row(room_m: float, top_m: float, bottom_m: float, wide_m: float, every_m: float, axis: int) -> tuple[Box, ...]:
    """Boxes across one axis of the map, from beyond one wall to beyond the other."""
    low, high = -_BEYOND_M, room_m + _BEYOND_M
    found = []
    for k in range(int((high - low) / every_m)):
        at = low + (k + 0.5) * every_m
        xy, size = (at, 0.5 * (low + high)), (wide_m, high - low)
        found.append(Box(xy if axis == 0 else xy[::-1], size if axis == 0 else size[::-1], bottom_m, top_m))
    return tuple(found)


def _middle(x0: float, x1: float, y0: float, y1: float) -> tuple[float, float]:
    return 0.5 * (x0 + x1), 0.5 * (y0 + y1)
