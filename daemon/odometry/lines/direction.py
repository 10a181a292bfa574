"""The rotation that the direction of lines tells, which is known modulo a quarter turn."""

from __future__ import annotations

import math

DIRECTION_SIGMAS = 5.0
"""Of a direction that is predicted or carried on, by which that of the lines may be off; chosen: noise alone exceeds it
in 6 of 10 million."""

_QUARTER_SIGMAS, _QUARTER_RAD = 4.0, 0.5 * math.pi
"""By which a prediction must be off to be in another quarter: once in 16,000."""


def knows_quarter(var_rad2: float) -> bool:
    """Whether a predicted rotation with this variance tells the heading to well within a quarter turn."""
    return _QUARTER_SIGMAS**2 * var_rad2 < (0.5 * _QUARTER_RAD) ** 2


def turn_by_lines(psi_ref: float, psi_curr: float, predicted: float, var_rad2: float, gate_rad: float) -> float | None:
    """direction_change(), where the prediction tells the quarter and the lines agree with it; else None.

    Args:
        var_rad2: of the prediction; gate_rad: by which lines may be off it, beside its error.
    """
    turn = direction_change(psi_ref, psi_curr, predicted)
    other = abs(turn - predicted) > gate_rad + DIRECTION_SIGMAS * math.sqrt(var_rad2)
    return turn if knows_quarter(var_rad2) and not other else None


def direction_change(psi_ref: float, psi_curr: float, predicted: float) -> float:
    """ref_from_curr rotation from the change of dominant direction: the branch modulo 90 deg nearest the prediction."""
    change = psi_ref - psi_curr
    branch = round((predicted - change) / _QUARTER_RAD)
    return float(change + branch * _QUARTER_RAD)
