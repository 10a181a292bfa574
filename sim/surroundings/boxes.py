"""Ceilings of more than one height: boxes that hang from the ceiling or below it, with an underside and four sides.

Boxes that reach up to the ceiling are beams and lower ceilings, others are ducts and trays.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ceilvo.sim.surroundings.surface import TEXEL_M, Array, Array32, Surface, mottled, surface

_SIDE = 0.8
"""Albedo of a side over the underside's: less light falls on it; chosen."""
_JOINT_TEXELS, _JOINT = 2, 0.16
"""Width and albedo of a joint between tiles: 8 mm, as dark as the ceiling's own."""
_TILE_SPREAD = 0.025
"""Relative standard deviation of the tiles' brightness, as on the ceiling."""


@dataclass(frozen=True)
class Box:
    """Something with flat sides, parallel to the map's axes.

    Attributes:
        xy_m: its centre in map.
        size_m: along x and y; whole texels of 4 mm are drawn.
        bottom_m, top_m: heights above the camera.
        tile_m: side of the tiles on its underside, 0 for none.
    """

    xy_m: tuple[float, float]
    size_m: tuple[float, float]
    bottom_m: float
    top_m: float
    albedo: float = 0.62
    tile_m: float = 0.0

    def corners(self) -> Array:
        """(4, 2) of its outline in map, as drawn."""
        half = 0.5 * TEXEL_M * np.array([_texels(v) for v in self.size_m])
        return np.asarray(np.array(self.xy_m) + np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half)

    def joints(self) -> tuple[Array, Array]:
        """Where the joints of its underside are, x and y in map: middles of what is drawn."""
        low = self.corners()[0]
        x, y = (low[k] + TEXEL_M * (at + 0.5 * _JOINT_TEXELS) for k, at in enumerate(self._joint_texels()))
        return x, y

    def _joint_texels(self) -> list[Array]:
        """First texels of the joints along x and y."""
        out = []
        for length in self.size_m:
            n = _texels(length)
            step = self.tile_m / TEXEL_M
            at = np.arange(0.5 * step, n - _JOINT_TEXELS, step) if step else np.zeros(0)
            out.append(np.round(at))
        return out

    def surfaces(self, rng: np.random.Generator) -> list[Surface]:
        """Its sides, then its underside."""
        x, y, up = np.eye(3)
        corners, along = self.corners(), (x, y, -x, -y)
        rows = _texels(self.top_m - self.bottom_m)
        found = []
        for k in range(4):
            body = mottled(_SIDE * self.albedo, rows, _texels(self.size_m[k % 2]), rng)
            start = np.array([*corners[k], self.bottom_m])
            found.append(surface(body, start + 0.5 * TEXEL_M * (along[k] + up), along[k], up, solid=True))
        start = np.array([*corners[0], self.bottom_m])
        found.append(surface(self._underside(rng), start + 0.5 * TEXEL_M * (x + y), x, y, solid=True))
        return found

    def _underside(self, rng: np.random.Generator) -> Array32:
        w, h = (_texels(v) for v in self.size_m)
        body = mottled(self.albedo, h, w, rng)
        if not self.tile_m:
            return body
        columns, lines = (at.astype(np.int64) for at in self._joint_texels())
        own = rng.normal(1.0, _TILE_SPREAD, (len(lines) + 1, len(columns) + 1)).astype(np.float32)
        j, i = np.searchsorted(lines, np.arange(h), "right"), np.searchsorted(columns, np.arange(w), "right")
        body *= own[j[:, None], i[None, :]]
        for at in columns:
            cv2.rectangle(body, (int(at), 0), (int(at) + _JOINT_TEXELS - 1, h - 1), _JOINT, -1)
        for at in lines:
            cv2.rectangle(body, (0, int(at)), (w - 1, int(at) + _JOINT_TEXELS - 1), _JOINT, -1)
        return body


def box_surfaces(boxes: tuple[Box, ...], rng: np.random.Generator) -> tuple[Surface, ...]:
    """All sides, then all undersides: an underside covers what begins above it."""
    parts = [b.surfaces(rng) for b in boxes]
    return (*(s for p in parts for s in p[:-1]), *(p[-1] for p in parts))


def _texels(length_m: float) -> int:
    return max(round(length_m / TEXEL_M), 4)
