"""The rotation that the direction of lines tells, which is known modulo a quarter turn."""

from __future__ import annotations

import math

DIRECTION_SIGMAS = 5.0
"""Of a direction that is predicted or carried on, by which that of the lines may be off; chosen: noise alone exceeds it
in 6 of 10 million."""


def direction_change(psi_ref: float, psi_curr: float, predicted: float) -> float:
    """ref_from_curr rotation from the change of dominant direction: the branch modulo 90 deg nearest the prediction."""
    change = psi_ref - psi_curr
    branch = round((predicted - change) / (0.5 * math.pi))
    return float(change + branch * 0.5 * math.pi)
