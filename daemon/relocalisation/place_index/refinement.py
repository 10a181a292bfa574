"""Poses moved to where their features lie best on the landmarks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import turned_type
from ceilvo.daemon.relocalisation.place_index.blocks import FINE_M, fine
from ceilvo.daemon.relocalisation.place_index.type_grid import TypeGrid, turns_to
from ceilvo.se2 import wrap_array
from ceilvo.types import Array, Ints, Observations

MAP_VAR_M2 = 1e-4
"""Of a landmark, added to that of a feature: 1 cm, a map in the making; chosen."""
HEADING_VAR_RAD2 = 1e-4
"""Of the lines' direction, where a view does not say: 0.6 deg."""
OTHER_M = 0.03
"""A residual so large halves a feature's weight (Cauchy's): part of a ceiling may be another one, whose features lie
some cm off, all alike; chosen: candidates are within 2 cm."""
PASSES = 2
"""The second without what the first has shown to be others."""
AT_ONCE = 1 << 14
"""Features of poses looked up together, so that their arrays stay in the cache; chosen."""


def refined(grid: TypeGrid, poses: Array, view: Observations) -> Array:
    """(M, 3) poses, for poses (M, 3) within about a third of the grid's reach and 2 deg of the truth.

    Weighted least squares of the residuals to the nearest landmarks of the features' types within reach; the heading
    is held by the variance of the lines' direction. Where no landmark is within reach, a pose stays as it is.
    """
    poses = np.array(np.reshape(poses, (-1, 3)), np.float64)
    kinds = np.array([turned_type(view.crossing_type, turn) for turn in range(4)])
    for part in np.array_split(np.arange(len(poses)), len(poses) * len(view) // AT_ONCE + 1):
        types = kinds[turns_to(view, poses[part, 2])]
        for _ in range(PASSES):
            poses[part] = _moved(grid, poses[part], view, types)
    return poses


def _moved(grid: TypeGrid, poses: Array, view: Observations, kind: Ints) -> Array:
    """Least squares of poses (M, 3), linearised there, with types (M, K)."""
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    x, y = view.xy_base_m.T
    arm = np.stack([c * x - s * y, s * x + c * y], axis=-1)
    residual, on = _residuals(grid, poses[:, None, :2] + arm, kind)
    weight = on / (np.mean(view.var_m2, axis=1) + MAP_VAR_M2) / (1.0 + np.sum(residual**2, axis=2) / OTHER_M**2)
    total = np.sum(weight, axis=1)
    share = weight / np.where(total > 0.0, total, 1.0)[:, None]
    centre, shift = (np.einsum("mk,mki->mi", share, a) for a in (arm, residual))
    a, r = arm - centre[:, None], residual - shift[:, None]
    pull = np.sum(weight * (a[..., 0] * r[..., 1] - a[..., 1] * r[..., 0]), axis=1)
    turn = pull / (np.sum(weight * np.sum(a * a, axis=2), axis=1) + 1.0 / _heading_var(view))
    shift += turn[:, None] * np.column_stack([centre[:, 1], -centre[:, 0]])  # the turn is about the robot
    moved = np.column_stack([poses[:, :2] + shift, wrap_array(poses[:, 2] + turn)])
    return np.where((total > 0.0)[:, None], moved, poses)


def _residuals(grid: TypeGrid, at: Array, kind: Ints) -> tuple[Array, NDArray[np.bool_]]:
    """(M, K, 2) from points (M, K, 2) to the nearest landmarks of their types, zero where (M, K) none is in reach."""
    points = fine(at.reshape(-1, 2))
    own = np.left_shift(1, kind.ravel()).astype(np.uint16)
    slot, _ = grid.blocks.nearest(points, own, int(fine(np.array(grid.reach_m))))
    residual = FINE_M * grid.blocks.xy.take(slot, axis=0) - at.reshape(-1, 2)
    residual[slot < 0] = 0.0
    return residual.reshape(at.shape), (slot >= 0).reshape(at.shape[:2])


def _heading_var(view: Observations) -> float:
    var = view.heading_var_rad2
    return var if np.isfinite(var) and var > 0.0 else HEADING_VAR_RAD2
