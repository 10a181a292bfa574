"""Whether a pose that was only assumed is right: a sequential test of what is seen against the map.

A grid of tiles agrees with any pose that is whole tiles off, so one good-looking view proves nothing. Views from
places a little apart are counted: how many features the map explains at a right pose and at one that is tiles off was
measured on simulated ceilings. Crossings of two grooves tell little each, the others (lamps, vents) much.
"""

from __future__ import annotations

import numpy as np

from ceilvo.kinds import crossing_kind
from ceilvo.types import Observations

GRID_CROSSING = int(crossing_kind(np.zeros(1, np.int64), np.zeros(1, np.int64))[0])
"""Two grooves."""

_RIGHT_GRID, _WRONG_GRID = 0.92, 0.80
_RIGHT_OTHER, _WRONG_OTHER = 0.50, 0.12
_ACCEPT = 6.0
_LEAST = -30.0
_MOST_A_VIEW = 2.5  # features of one view share lines, so they agree or disagree together
_OTHERS_NEEDED = 4
_FEWEST_SURE = 5
_SURE_SHARE = 0.6


class Confirmation:
    """Log-likelihood ratio of "right" against "tiles off"; `sure` hypotheses are within a fraction of a tile."""

    def __init__(self, sure: bool) -> None:
        self._sure = sure
        self._ratio = 0.0
        self._others = 0

    def weigh(self, observations: Observations, nis: float, nis_max: float) -> bool:
        """Take in one view from a new place; True once the hypothesis is confirmed."""
        known = observations.label >= 0
        grid = observations.kind == GRID_CROSSING
        if self._sure:
            enough = np.count_nonzero(known) >= max(_FEWEST_SURE, _SURE_SHARE * len(observations))
            return bool(enough) and nis <= nis_max
        gain = _log_ratio(known[grid], _RIGHT_GRID, _WRONG_GRID) + _log_ratio(known[~grid], _RIGHT_OTHER, _WRONG_OTHER)
        self._ratio = max(self._ratio + min(gain, _MOST_A_VIEW), _LEAST)
        self._others += int(np.count_nonzero(known & ~grid))
        return self._ratio >= _ACCEPT and self._others >= _OTHERS_NEEDED and nis <= nis_max


def _log_ratio(known: np.typing.NDArray[np.bool_], right: float, wrong: float) -> float:
    yes, no = int(np.count_nonzero(known)), int(np.count_nonzero(~known))
    return yes * float(np.log(right / wrong)) + no * float(np.log((1.0 - right) / (1.0 - wrong)))
