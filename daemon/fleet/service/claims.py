"""What robots have measured and the map does not have yet: information, which adds up."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.fleet.offers import Measured, covariances_of, places_of
from ceilvo.types import Array

LEAST_SIGMA_M = 2e-3
"""Of what one robot knows of a landmark, however often it has seen it; chosen: its calibration is no better."""
CLAIM = np.dtype(
    [
        ("key", "<i8"),
        ("ref", "<i8"),
        ("kind", "<i8"),
        *((name, "<f8") for name in ("lxx", "lxy", "lyy", "ex", "ey")),
        *((name, "<i8") for name in ("seen", "expected", "alone")),
    ]
)
Claims = NDArray[Any]
"""(C,) of CLAIM: the number of the robot's key, the landmark as in an offer, inverse covariance (1/m2), that times
the place (1/m), counts, and whether the claim needs nobody else's."""
VALUES = ("kind", "lxx", "lxy", "lyy", "ex", "ey", "seen", "expected", "alone")


def claims_of(rows: Measured, key: int, alone: bool) -> Claims:
    out = np.empty(len(rows), CLAIM)
    out["key"], out["alone"] = key, alone
    for name in ("ref", "kind", "seen", "expected"):
        out[name] = rows[name]
    information = np.linalg.inv(covariances_of(rows))
    e = np.einsum("nij,nj->ni", information, places_of(rows))
    e[rows["seen"] == 0] = 0.0
    information[rows["seen"] == 0] = 0.0
    out["lxx"], out["lxy"], out["lyy"] = information[:, 0, 0], information[:, 0, 1], information[:, 1, 1]
    out["ex"], out["ey"] = e.T
    return out


def is_placed(claims: Claims) -> NDArray[np.bool_]:
    """(C,) which say where their landmark is, not only that it was missed."""
    return np.asarray(claims["lxx"] * claims["lyy"] - claims["lxy"] ** 2 > 0.0)


def places_and_covariances(claims: Claims) -> tuple[Array, Array]:
    """(C, 2) and (C, 2, 2) of claims that are placed, none surer than LEAST_SIGMA_M."""
    information = np.column_stack([claims[n] for n in ("lxx", "lxy", "lxy", "lyy")]).reshape(-1, 2, 2)
    cov = np.linalg.inv(information)
    xy = np.einsum("nij,nj->ni", cov, np.column_stack([claims["ex"], claims["ey"]]))
    return xy, np.asarray(0.5 * (cov + np.swapaxes(cov, 1, 2)) + LEAST_SIGMA_M**2 * np.eye(2))


def combined(claims: Claims) -> Claims:
    """One claim for each key and landmark."""
    order = np.lexsort((claims["ref"], claims["key"]))
    c = claims[order]
    if not len(c):
        return c
    new = np.ones(len(c), bool)
    new[1:] = (c["key"][1:] != c["key"][:-1]) | (c["ref"][1:] != c["ref"][:-1])
    first = np.flatnonzero(new)
    out = c[first]
    for name in VALUES[1:-1]:
        out[name] = np.add.reduceat(c[name], first)
    out["alone"] = np.maximum.reduceat(c["alone"], first)
    return out
