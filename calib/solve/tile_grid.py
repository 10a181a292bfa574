"""The square grid of a tiled ceiling in pictures: its spacing over the ceiling's height, by evidence, and tile indices.

Not the lattice of daemon.relocalisation: that one finds the shifts under which a map in metres, of any two axes, looks
the same. Here the axes are known from the lines, the scale is not, and each picture has a phase of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.targets.ceiling_view import MIN_CROSSINGS, GridView

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_ON_GRID_TILES = 0.12
_FINEST, _COARSEST, _TRIED = 0.02, 2.5, 6000
_PEAK_FRACTION = 0.4
_MOST_PEAKS = 40
_SAME_SPACING = 0.05


@dataclass(frozen=True)
class TileIndex:
    """Crossings of one picture that are on the grid.

    Attributes:
        index: (K, 2) whole tiles from the picture's own origin, which is the crossing nearest to the camera's foot.
        used: (K,) their rows in the GridView.
        xy_yaw: (3,) the camera's place in the grid in tiles, and its heading, to start a fit from.
    """

    index: Ints
    used: Ints
    xy_yaw: Array


@dataclass(frozen=True)
class Spacing:
    """A spacing with what speaks for it.

    Attributes:
        tile_over_height: side of a tile over the ceiling's height.
        on_grid: fraction of the crossings that are on the grid.
        filled: fraction of the grid's nodes, where crossings were seen, that have one.
    """

    tile_over_height: float
    on_grid: float
    filled: float

    @property
    def support(self) -> float:
        """0..1, the harmonic mean: half the spacing leaves nodes empty, twice the spacing leaves crossings out."""
        total = self.on_grid + self.filled
        return 2.0 * self.on_grid * self.filled / total if total > 0 else 0.0


def tile_spacings(views: list[GridView], between: tuple[float, float] = (_FINEST, _COARSEST)) -> list[Spacing]:
    """Every spacing that the crossings are periodic with, best supported first; each at least 5 % from the others.

    Args:
        between: the smallest and the largest tile over height that is possible.
    """
    s = np.geomspace(_FINEST, _COARSEST, _TRIED)
    score, count = np.zeros(len(s)), 0
    for view in views:
        for c in _in_grid_axes(view).T:
            waves = np.exp(2j * np.pi * c[None, :] / s[:, None])
            score += np.abs(waves.sum(axis=1))
            count += len(c)
    if count == 0:
        return []
    score = score / count
    wide = max(float(np.ptp(_in_grid_axes(v), axis=0).min()) for v in views)
    score[(s > 0.75 * wide) | (s < between[0]) | (s > between[1])] = 0.0  # what fits in less than twice fits anything
    peaks = np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:]) & (score[1:-1] > 0)) + 1
    peaks = peaks[score[peaks] >= _PEAK_FRACTION * score.max()]
    peaks = peaks[np.argsort(-score[peaks])][:_MOST_PEAKS]
    found = sorted((_supported(views, float(s[k])) for k in peaks), key=lambda f: -f.support)
    out: list[Spacing] = []
    for f in found:
        if all(abs(np.log(f.tile_over_height / o.tile_over_height)) > _SAME_SPACING for o in out):
            out.append(f)
    return out


def _supported(views: list[GridView], tile_over_height: float) -> Spacing:
    used = nodes = total = 0.0
    for view in views:
        on_grid = tile_index(view, tile_over_height)
        hull = cv2.convexHull(_in_grid_axes(view).astype(np.float32))
        # Pick's theorem, for a hull whose corners are nodes
        nodes += cv2.contourArea(hull) / tile_over_height**2 + 0.5 * cv2.arcLength(hull, True) / tile_over_height + 1.0
        total += len(view.xy)
        used += 0 if on_grid is None else len(np.unique(on_grid.index, axis=0))
    return Spacing(tile_over_height, used / total, min(used / nodes, 1.0))


def tile_index(view: GridView, tile_over_height: float) -> TileIndex | None:
    """Whole-tile coordinates, or None when too few crossings are on the grid."""
    c = _in_grid_axes(view)
    phase = np.array([_phase(axis / tile_over_height) for axis in c.T])
    k = c / tile_over_height - phase
    index = np.rint(k).astype(np.int64)
    used = np.flatnonzero((np.abs(k - index) < _ON_GRID_TILES).all(axis=1))
    if len(used) < MIN_CROSSINGS or (np.ptp(index[used], axis=0) < 1).any():
        return None
    return TileIndex(index[used], used, np.array([*-phase, -view.psi_rad]))


def _phase(k: Array) -> float:
    """Where most of the coordinates lie within a whole, -0.5 to 0.5; their mean would lie between two crowds."""
    turns = np.exp(2j * np.pi * k)
    apart = np.abs(np.angle(turns[:, None] * turns.conj()[None])) / (2.0 * np.pi)
    crowd = apart[int(np.argmax((apart < _ON_GRID_TILES).sum(axis=1)))] < _ON_GRID_TILES
    return float(np.angle(turns[crowd].sum())) / (2.0 * np.pi)


def _in_grid_axes(view: GridView) -> Array:
    """(N, 2) crossings in the grid's own axes."""
    c, s = np.cos(view.psi_rad), np.sin(view.psi_rad)
    return np.asarray(view.xy @ np.array([[c, -s], [s, c]]))
