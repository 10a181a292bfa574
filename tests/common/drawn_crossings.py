"""Crossings and points of a view that are where a test puts them, without a picture."""

from __future__ import annotations

import numpy as np

from ceilvo.types import NO_DIRECTION_RAD, Array, Crossings, Ints

PX_PER_M = 186.0
"""Of a level view of 640x480 px."""


def crossings_at(
    xy: Array,
    kind: Ints | int,
    sigma_m: Array | float,
    psi_rad: float = 0.0,
    psi_sigma_rad: float = NO_DIRECTION_RAD,
    tilt_rad: Array | None = None,
) -> Crossings:
    """At (N, 2) m in base, of types (N,), each with its standard deviation (N,), or all alike.

    Lines tell no direction unless its standard deviation is given.
    """
    variance = np.broadcast_to(np.asarray(sigma_m, np.float64) ** 2, len(xy))
    return Crossings(
        uv_px=PX_PER_M * xy + np.array([320.0, 240.0]),
        xy_base_m=xy,
        cov_base_m2=variance[:, None, None] * np.eye(2),
        crossing_type=np.array(np.broadcast_to(kind, len(xy))),
        psi_rad=psi_rad,
        psi_sigma_rad=psi_sigma_rad,
        tilt_rad=np.zeros(2) if tilt_rad is None else tilt_rad,
        tilt_sigma_rad=np.zeros(2),
        common_cov_m2=np.zeros((2, 2)),
    )
