"""What a feature of a view is worth beside the others, and which of them are weighed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import LINE_CROSSINGS
from ceilvo.daemon.odometry.sight import crowd
from ceilvo.daemon.relocalisation.evidence.type_raster import REACH_M
from ceilvo.types import Array, Observations

LAMP_CELL_M, LAMP_FEATURES = 0.4, 4.0
"""Rare features of a cell and the eight around it are one lamp's, and are worth so many together: where one corner is,
the others are; chosen."""
MOST_RARE, MOST_COMMON = 40, 16
"""Features of a view that are weighed at every place, for time: of types that tell places apart, and of others."""
_TINY = 1e-12
"""m^2, in place of a variance that is zero."""


def of_lamp(xy_m: Array, rare: NDArray[np.bool_]) -> Array:
    """(N,) worth of features (N, 2) beside those of the same lamp; of a feature that is not rare 1."""
    out = np.ones(len(xy_m))
    out[rare] = np.minimum(LAMP_FEATURES / np.maximum(crowd(xy_m[rare], LAMP_CELL_M), 1.0), 1.0)
    return out


def of_place(view: Observations) -> Array:
    """(K,) worth of features by how well their places are known: of points, which no line holds in theirs.

    One whose error takes it beyond the reach of its own landmark as often as not says nothing.
    """
    variance = np.mean(view.var_m2, axis=1) - view.common_var_m2
    within = 1.0 - np.exp(-0.5 * REACH_M**2 / np.maximum(variance, _TINY))
    return np.where(view.crossing_type >= LINE_CROSSINGS, np.maximum(2.0 * within - 1.0, 0.0), 1.0)


def telling(chance: Array, rare: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(K,) features that are weighed: of the rare ones those that chance (K,) explains least, and a few others."""
    out = np.zeros(len(chance), bool)
    few = np.flatnonzero(rare)
    out[few[np.argsort(chance[few], kind="stable")[:MOST_RARE]]] = True
    usual = np.flatnonzero(~rare)
    out[usual[:: max(len(usual) // MOST_COMMON, 1)]] = True
    return out
