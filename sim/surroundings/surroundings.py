"""What a camera under a ceiling sees besides it: things that hang lower, a part of the robot itself, walls with doors.

Each is a flat picture with transparency somewhere in space. Heights are metres above the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from ceilvo.sim.surroundings.boxes import Box, box_surfaces
from ceilvo.sim.surroundings.surface import TEXEL_M, Array32, Surface, mottled, surface

_WALL, _FRAME, _LEAF, _RAIL = 0.62, 0.22, 0.48, 0.30
"""Albedo of a wall, a door's frame and leaf, and a rail; chosen."""
_SEAM_M, _SEAM, _RAIL_M, _FRAME_M, _DOOR_M, _DOOR_SHIFT = 0.03, 0.6, 0.03, 0.07, 0.9, 0.15
"""A slab's seam from its edge and its relative albedo, widths of rail, frame and door, and how far off its place a door
is, in doors; chosen."""


@dataclass(frozen=True)
class Slab:
    """A rectangular plate parallel to the ceiling, for example the underside of a duct or a cupboard.

    Attributes:
        xy_m: its centre, in map or in base.
        size_m: along its own x and y.
        yaw_rad: its x axis against that frame.
        height_m: above the camera.
        frame: "map" hangs in the room, "base" goes with the robot.
    """

    xy_m: tuple[float, float]
    size_m: tuple[float, float]
    yaw_rad: float = 0.0
    height_m: float = 1.5
    albedo: float = 0.42
    frame: Literal["map", "base"] = "map"


@dataclass(frozen=True)
class SurroundingsSpec:
    """Nothing by default. walls stand along the sides of the room, from below the camera up to the ceiling."""

    slabs: tuple[Slab, ...] = ()
    boxes: tuple[Box, ...] = ()
    walls: bool = False
    doors_per_wall: int = 2
    door_top_m: float = 1.55
    rail_m: float = 1.9


def make_surfaces(spec: SurroundingsSpec, room_m: float, ceiling_m: float, seed: int) -> tuple[Surface, ...]:
    """Far ones first: walls, then boxes, then slabs from high to low."""
    rng = np.random.default_rng([seed, 0x5AAB])
    walls = _walls(spec, room_m, ceiling_m, rng) if spec.walls else ()
    slabs = sorted(spec.slabs, key=lambda s: -s.height_m)
    boxes = box_surfaces(spec.boxes, np.random.default_rng([seed, 0xB0C5]))
    return (*walls, *boxes, *(_slab_surface(s, rng) for s in slabs))


def _slab_surface(slab: Slab, rng: np.random.Generator) -> Surface:
    w, h = (max(round(v / TEXEL_M), 4) for v in slab.size_m)
    body = mottled(slab.albedo, h, w, rng)
    seam = max(int(_SEAM_M / TEXEL_M), 1)
    cv2.rectangle(body, (seam, seam), (w - 1 - seam, h - 1 - seam), _SEAM * slab.albedo, 2)
    c, s = np.cos(slab.yaw_rad), np.sin(slab.yaw_rad)
    u, v = np.array([c, s, 0.0]), np.array([-s, c, 0.0])
    middle = np.array([*slab.xy_m, slab.height_m])
    corner = middle - 0.5 * ((w - 1) * u + (h - 1) * v) * TEXEL_M
    return surface(body, corner, u, v, slab.frame)


def _walls(spec: SurroundingsSpec, room_m: float, ceiling_m: float, rng: np.random.Generator) -> tuple[Surface, ...]:
    """Four vertical pictures; columns run along the wall, rows from the camera's height up to the ceiling."""
    up = np.array([0.0, 0.0, 1.0])
    out = []
    for k in range(4):
        along = np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)][k])
        start = np.array([(0.0, 0.0, 0.0), (room_m, 0.0, 0.0), (room_m, room_m, 0.0), (0.0, room_m, 0.0)][k])
        body = _wall_picture(spec, room_m, ceiling_m, rng)
        out.append(surface(body, start + 0.5 * TEXEL_M * (along + up), along, up, "map"))
    return tuple(out)


def _wall_picture(spec: SurroundingsSpec, room_m: float, ceiling_m: float, rng: np.random.Generator) -> Array32:
    w, h = round(room_m / TEXEL_M), round(ceiling_m / TEXEL_M)
    body = mottled(_WALL, h, w, rng)
    rail = round(spec.rail_m / TEXEL_M)
    body[rail : rail + round(_RAIL_M / TEXEL_M)] = _RAIL
    top, frame = round(spec.door_top_m / TEXEL_M), round(_FRAME_M / TEXEL_M)
    for i in range(spec.doors_per_wall):
        at = (i + 0.5 + rng.uniform(-_DOOR_SHIFT, _DOOR_SHIFT)) * room_m / spec.doors_per_wall
        a, b = round((at - 0.5 * _DOOR_M) / TEXEL_M), round((at + 0.5 * _DOOR_M) / TEXEL_M)
        body[:top, max(a, 0) : b] = _FRAME
        body[: top - frame, max(a + frame, 0) : b - frame] = _LEAF
    return body
