"""Where on a known map is what is seen? Every place and quarter turn at once, by counting features that hit a landmark.

The direction of the ceiling's lines leaves four headings; for each, the map is a stack of pictures, one a kind, with a
disc at every landmark, and a view is a sum of shifted pictures.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES, turned_type
from ceilvo.se2 import rotation, wrap
from ceilvo.types import Array, Landmarks, Observations

_CELL_M = 0.05
"""Side of a cell of the raster; a few sigmas of a landmark."""
_DISC_CELLS = 3
"""A feature hits a landmark within so many cells: 0.15 m, about the association gate."""
_GROUND_CELLS = 8
"""Ground counts as mapped so many cells around those discs: less than a tile, so that a missing neighbour shows."""
_STEP_CELLS = 2
"""Positions are tried every second cell, 0.1 m, which no disc of 0.15 m slips through."""
_MARGIN_M = 1.0
"""The robot may stand so far outside the mapped ceiling."""
_MOST_CELLS = 4_000_000
"""Of a larger map nothing is searched: 36 MB of raster, 100 m x 90 m."""
_MAPPED_FRACTION = 0.9
"""All that is within reach is mapped where this fraction of a view is on mapped ground from everywhere; chosen."""
_SAME_PLACE_M = 0.3
"""Half a tile of 0.6 m: poses nearer to each other are one place."""


@dataclass(frozen=True, slots=True)
class ReachableRegion:
    """Where a robot should be (3,) by its way since it was last sure, and how far off that it can be at most."""

    pose: Array
    reach_m: float


@dataclass(frozen=True, slots=True)
class Place:
    """A pose (3,) on the map, how many features it explains, and how many the pose asked about does.

    elsewhere: how many the best place that is not the pose asked about explains.
    near: places have to be near this, where the map does not know all ground that the robot may be on.
    """

    pose: Array
    explained: int
    here: int
    elsewhere: int
    near: ReachableRegion | None = None

    def allows(self, pose: Array) -> bool:
        """Whether the robot can be at a pose (3,)."""
        return self.near is None or float(np.hypot(*(pose - self.near.pose)[:2])) <= self.near.reach_m


def search_places(
    landmarks: Landmarks, observations: Observations, pose: Array, region: ReachableRegion | None = None
) -> Place | None:
    """The pose of the whole map that explains most of a view, beside the given one; None without a map.

    Where a ceiling repeats itself, ground that the map lacks looks like some that it has: unless all that is within
    reach of `region` is mapped, only places within reach count.

    Positions are tried every 0.1 m, a feature hits within 0.15 m.
    """
    reach_m = float(np.max(np.hypot(*observations.xy_base_m.T), initial=0.0))
    pad = int(np.ceil(reach_m / _CELL_M)) + 1
    raster = _Raster.of(landmarks, pad)
    if raster is None or not len(observations):
        return None
    near = None if region is None or raster.knows(region, observations) else region
    best, here, elsewhere = (-1, np.zeros(3)), 0, 0
    for turn in range(4):
        theta = wrap(observations.heading_rad - 0.5 * np.pi * turn)
        counts = raster.count(observations.xy_base_m @ rotation(theta).T, turned_type(observations.crossing_type, turn))
        others = counts
        if abs(wrap(theta - float(pose[2]))) < 0.25 * np.pi:
            here = raster.near(counts, pose[:2])
            others = np.where(raster.within(pose, _SAME_PLACE_M), 0, counts)
        if near is not None:
            possible = raster.within(near.pose, near.reach_m)
            counts, others = counts * possible, others * possible
        elsewhere = max(elsewhere, int(np.max(others)))
        y, x = np.unravel_index(int(np.argmax(counts)), counts.shape)
        if int(counts[y, x]) > best[0]:
            best = (int(counts[y, x]), np.array([*raster.position(int(x), int(y)), theta]))
    return Place(best[1], best[0], here, elsewhere, near)


def _widened(image: NDArray[np.uint8], cells: int) -> NDArray[np.uint8]:
    """With a disc of so many cells around every set one."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * cells + 1, 2 * cells + 1))
    return np.asarray(cv2.dilate(image, disc), np.uint8)


class _Raster:
    def __init__(self, images: NDArray[np.uint8], origin_m: Array, pad: int) -> None:
        self._images, self._origin_m, self._pad = images, origin_m, pad

    @staticmethod
    def of(landmarks: Landmarks, pad: int) -> _Raster | None:
        xy = landmarks.xy_map_m
        if not len(xy):
            return None
        low, high = xy.min(axis=0) - _MARGIN_M, xy.max(axis=0) + _MARGIN_M
        width, height = (int(n) + 2 * pad for n in np.ceil((high - low) / _CELL_M) + 1)
        if width * height > _MOST_CELLS:
            return None
        images = np.zeros((CROSSING_TYPES, height, width), np.uint8)
        col, row = (np.round((xy - low) / _CELL_M).astype(np.int64) + pad).T
        images[landmarks.crossing_type, row, col] = 1
        for image in images:
            image[:] = _widened(image, _DISC_CELLS)
        return _Raster(images, low, pad)

    def count(self, offset_m: Array, kind: NDArray[np.int64]) -> NDArray[np.int32]:
        """(Y, X) features that hit, with the robot at every second cell and features at these offsets (N, 2)."""
        pad, (_, height, width) = self._pad, self._images.shape
        rows, cols = height - 2 * pad, width - 2 * pad
        out = np.zeros((-(-rows // _STEP_CELLS), -(-cols // _STEP_CELLS)), np.int32)
        for (dx, dy), k in zip(np.round(offset_m / _CELL_M).astype(np.int64), kind, strict=True):
            top, left = pad + dy, pad + dx
            out += self._images[k, top : top + rows : _STEP_CELLS, left : left + cols : _STEP_CELLS]
        return out

    def within(self, pose: Array, reach_m: float) -> NDArray[np.bool_]:
        """(Y, X) elements of count() that are so near a pose."""
        rows, cols = (-(-(n - 2 * self._pad) // _STEP_CELLS) for n in self._images.shape[1:])
        x, y = ((np.arange(n) * _STEP_CELLS * _CELL_M + o) for n, o in zip((cols, rows), self._origin_m, strict=True))
        return np.asarray(np.hypot(x - pose[0], y[:, None] - pose[1]) <= reach_m)

    def knows(self, region: ReachableRegion, observations: Observations) -> bool:
        """Whether the map has landmarks all around every feature, wherever within reach the robot is."""
        rows, cols = self._images.shape[1:]
        size_m = _CELL_M * (np.array([cols, rows]) - 2 * self._pad)
        inside = np.minimum(region.pose[:2] - self._origin_m, self._origin_m + size_m - region.pose[:2])
        if float(np.min(inside)) < region.reach_m:
            return False
        ground = _widened(np.max(self._images, axis=0), _GROUND_CELLS)
        offset_m = observations.xy_base_m @ rotation(float(region.pose[2])).T
        count = _Raster(ground[None], self._origin_m, self._pad).count(offset_m, np.zeros(len(offset_m), np.int64))
        return bool(np.all(count[self.within(region.pose, region.reach_m)] >= _MAPPED_FRACTION * len(offset_m)))

    def position(self, x: int, y: int) -> tuple[float, float]:
        """Metres in map of an element of count()."""
        at = self._origin_m + _STEP_CELLS * _CELL_M * np.array([x, y])
        return float(at[0]), float(at[1])

    def near(self, counts: NDArray[np.int32], xy_m: Array) -> int:
        """The most that is explained within a step of a position; 0 off the map."""
        x, y = np.round((xy_m - self._origin_m) / (_STEP_CELLS * _CELL_M)).astype(np.int64)
        part = counts[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] if min(x, y) >= -1 else counts[:0]
        return int(part.max()) if part.size else 0
