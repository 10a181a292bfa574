"""Which lattice the crossings of a tiled ceiling lie on: its spacing, by evidence, and whole-tile coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.targets.ceiling_view import MIN_CROSSINGS, GridView

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

_NEAR_SHARE = 0.12
_FINEST, _COARSEST, _TRIED = 0.02, 2.5, 6000
_PEAK_SHARE = 0.4
_MOST_PEAKS = 40
_SAME_SPACING = 0.05


@dataclass(frozen=True)
class Lattice:
    """Crossings of one picture that are on the grid.

    Attributes:
        index: (K, 2) whole tiles from the picture's own origin, which is the crossing nearest to the camera's foot.
        used: (K,) their rows in the GridView.
        xy_yaw: (3,) the camera's place in the lattice in tiles, and its heading, to start a fit from.
    """

    index: Ints
    used: Ints
    xy_yaw: Array


@dataclass(frozen=True)
class Spacing:
    """A spacing with what speaks for it.

    Attributes:
        share: side of a tile over the ceiling's height.
        on_grid: share of the crossings that are on the lattice.
        filled: share of the lattice's nodes, where crossings were seen, that have one.
    """

    share: float
    on_grid: float
    filled: float

    @property
    def support(self) -> float:
        """0..1, the harmonic mean: half the spacing leaves nodes empty, twice the spacing leaves crossings out."""
        total = self.on_grid + self.filled
        return 2.0 * self.on_grid * self.filled / total if total > 0 else 0.0


def spacings(views: list[GridView], between: tuple[float, float] = (_FINEST, _COARSEST)) -> list[Spacing]:
    """Every spacing that the crossings are periodic with, best supported first; each at least 5 % from the others.

    Args:
        between: the smallest and the largest tile over height that is possible.
    """
    s = np.geomspace(_FINEST, _COARSEST, _TRIED)
    score, count = np.zeros(len(s)), 0
    for view in views:
        for c in _along(view).T:
            waves = np.exp(2j * np.pi * c[None, :] / s[:, None])
            score += np.abs(waves.sum(axis=1))
            count += len(c)
    if count == 0:
        return []
    score = score / count
    wide = max(float(np.ptp(_along(v), axis=0).min()) for v in views)
    score[(s > 0.75 * wide) | (s < between[0]) | (s > between[1])] = 0.0  # what fits in less than twice fits anything
    peaks = np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:]) & (score[1:-1] > 0)) + 1
    peaks = peaks[score[peaks] >= _PEAK_SHARE * score.max()]
    peaks = peaks[np.argsort(-score[peaks])][:_MOST_PEAKS]
    found = sorted((_supported(views, float(s[k])) for k in peaks), key=lambda f: -f.support)
    out: list[Spacing] = []
    for f in found:
        if all(abs(np.log(f.share / o.share)) > _SAME_SPACING for o in out):
            out.append(f)
    return out


def _supported(views: list[GridView], share: float) -> Spacing:
    used = nodes = total = 0.0
    for view in views:
        lattice = to_lattice(view, share)
        hull = cv2.convexHull(_along(view).astype(np.float32))
        # Pick's theorem, for a hull whose corners are nodes
        nodes += cv2.contourArea(hull) / share**2 + 0.5 * cv2.arcLength(hull, True) / share + 1.0
        total += len(view.xy)
        used += 0 if lattice is None else len(np.unique(lattice.index, axis=0))
    return Spacing(share, used / total, min(used / nodes, 1.0))


def to_lattice(view: GridView, tile_share: float) -> Lattice | None:
    """Whole-tile coordinates, or None when too few crossings are on the grid."""
    c = _along(view)
    phase = np.array([_phase(axis / tile_share) for axis in c.T])
    k = c / tile_share - phase
    index = np.rint(k).astype(np.int64)
    used = np.flatnonzero((np.abs(k - index) < _NEAR_SHARE).all(axis=1))
    if len(used) < MIN_CROSSINGS or (np.ptp(index[used], axis=0) < 1).any():
        return None
    return Lattice(index[used], used, np.array([*-phase, -view.psi_rad]))


def _phase(k: Array) -> float:
    """Where most of the coordinates lie within a whole, -0.5 to 0.5; their mean would lie between two crowds."""
    turns = np.exp(2j * np.pi * k)
    apart = np.abs(np.angle(turns[:, None] * turns.conj()[None])) / (2.0 * np.pi)
    crowd = apart[int(np.argmax((apart < _NEAR_SHARE).sum(axis=1)))] < _NEAR_SHARE
    return float(np.angle(turns[crowd].sum())) / (2.0 * np.pi)


def _along(view: GridView) -> Array:
    """(N, 2) crossings in the grid's own axes."""
    c, s = np.cos(view.psi_rad), np.sin(view.psi_rad)
    return np.asarray(view.xy @ np.array([[c, -s], [s, c]]))
