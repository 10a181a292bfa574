"""Whether a pose that was only assumed is right: it must explain what is seen better than its neighbours do.

A grid of tiles agrees with any pose that is whole tiles off, so that most features fit proves nothing. The rivals are
tried on the same views: the assumed pose is believed once it has explained clearly more features than the best of the
poses one tile away, over views from places a little apart. A bare grid decides nothing, and then nothing is believed.
"""

from __future__ import annotations

import numpy as np

from ceilvo.types import Array, Landmarks

_MARGIN = 8
_SURE_SHARE = 0.6
_FEWEST = 5
_FEWEST_LANDMARKS = 6


class Confirmation:
    """Counts explained features; `sure` hypotheses are within a fraction of a tile and need no rivals."""

    def __init__(self, sure: bool) -> None:
        self._sure = sure
        self._explained: Array = np.zeros(1)

    def weigh(self, explained: Array, seen: int, nis: float, nis_max: float) -> bool:
        """Take in one view from a new place.

        Args:
            explained: (1 + K,) features that the map explains from the assumed pose and from its K rivals.
            seen: features in the view.

        Returns:
            True once the hypothesis is confirmed.
        """
        if explained.shape != self._explained.shape:
            self._explained = np.zeros(explained.shape)
        self._explained = self._explained + explained
        fits = explained[0] >= max(_FEWEST, _SURE_SHARE * seen) and nis <= nis_max
        if self._sure:
            return bool(fits)
        ahead = self._explained[0] - np.max(self._explained[1:], initial=0.0)
        return bool(fits and len(explained) > 1 and ahead >= _MARGIN)


def rivals(pose: Array, landmarks: Landmarks, map_axis_rad: float) -> Array:
    """(K, 3) poses one tile away along and across the map's axes, K = 8, or 0 where the map shows no tiles."""
    xy = landmarks.xy_map_m
    if len(xy) < _FEWEST_LANDMARKS:
        return np.zeros((0, 3))
    kinds, counts = np.unique(landmarks.kind, return_counts=True)
    same = xy[landmarks.kind == kinds[np.argmax(counts)]]
    if len(same) < _FEWEST_LANDMARKS:
        return np.zeros((0, 3))
    apart = np.hypot(same[:, None, 0] - same[None, :, 0], same[:, None, 1] - same[None, :, 1])
    np.fill_diagonal(apart, np.inf)
    tile = float(np.median(np.min(apart, axis=1)))
    c, s = np.cos(map_axis_rad), np.sin(map_axis_rad)
    steps = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]
    shift = tile * np.array([(i * c - j * s, i * s + j * c, 0.0) for i, j in steps])
    return np.asarray(pose + shift)
