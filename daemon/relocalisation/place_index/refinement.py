"""Poses moved to where their features lie best on the landmarks."""

from __future__ import annotations

import numpy as np

from ceilvo.crossing_types import turned_type
from ceilvo.daemon.relocalisation.place_index.blocks import FINE_M, fine
from ceilvo.daemon.relocalisation.place_index.type_grid import TypeGrid, turns_to
from ceilvo.se2 import rotation, wrap
from ceilvo.types import Array, Observations

ROUNDS = 2
"""The second with the neighbours of the first's pose."""
MAP_VAR_M2 = 1e-4
"""Of a landmark, added to that of a feature: 1 cm, a map in the making; chosen."""
HEADING_VAR_RAD2 = 1e-4
"""Of the lines' direction, where a view does not say: 0.6 deg."""


def refined(grid: TypeGrid, poses: Array, view: Observations) -> Array:
    """(M, 3) poses, for poses (M, 3) within about a third of the grid's reach and 2 deg of the truth."""
    return np.array([_refined(grid, pose, view) for pose in np.reshape(poses, (-1, 3))]).reshape(-1, 3)


def _refined(grid: TypeGrid, pose: Array, view: Observations) -> Array:
    reach = int(fine(np.array(grid.reach_m)))
    weight = 1.0 / (np.mean(view.var_m2, axis=1) + MAP_VAR_M2)
    var = view.heading_var_rad2
    stiff = 1.0 / var if np.isfinite(var) and var > 0.0 else 1.0 / HEADING_VAR_RAD2
    kind = turned_type(view.crossing_type, int(turns_to(view, pose[2:])[0]))
    start = float(pose[2])
    for _ in range(ROUNDS):
        arm = view.xy_base_m @ rotation(float(pose[2])).T
        slot, _ = grid.blocks.nearest(fine(pose[:2] + arm), kind, reach)
        on = slot >= 0
        if not np.any(on):
            break
        w, arm = weight[on, None] / np.sum(weight[on]), arm[on]
        residual = FINE_M * grid.blocks.xy[slot[on]] - pose[:2] - arm
        centre, shift = np.sum(w * arm, axis=0), np.sum(w * residual, axis=0)
        a, r = arm - centre, residual - shift
        spread = np.sum(weight[on] * np.sum(a * a, axis=1))
        pull = np.sum(weight[on] * (a[:, 0] * r[:, 1] - a[:, 1] * r[:, 0]))
        turn = (pull - stiff * wrap(float(pose[2]) - start)) / (spread + stiff)
        shift = shift - turn * np.array([-centre[1], centre[0]])
        pose = np.array([*(pose[:2] + shift), wrap(float(pose[2]) + turn)])
    return pose
