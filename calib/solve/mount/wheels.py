"""The wheels' scale: what they reported of the spin and the run against what the ceiling showed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve.mount.fit import Solution
from ceilvo.calib.solve.mount.tracks import MIN_PICTURES, MountPicture, Track

Array = NDArray[np.float64]

_PARTS = 5
"""Of the run, whose scales scatter by what one scale is worth; chosen: three pictures or more in each."""
_STANDING = 0.1
"""Of the run's length: wheels that reported less did not count, or counted something else; chosen."""
_MIN_TURN_RAD = 1.0
"""Reported turn below which its scale says nothing; a spin has 200 deg or more."""


def wheel_scale(
    spin: list[MountPicture], run: list[MountPicture], s: Solution, tracks: list[Track]
) -> tuple[float | None, float | None, float | None]:
    """True over reported: distance with its sigma, and turn; None where the wheels are not known."""
    known = [
        np.flatnonzero([part[i].wheels is not None for i in track.rows])
        for part, track in zip((spin, run), tracks, strict=True)
    ]
    if any(len(k) < MIN_PICTURES for k in known):
        return None, None, None
    turns, path = (
        np.array([part[track.rows[i]].wheels for i in k], np.float64)
        for part, track, k in zip((spin, run), tracks, known, strict=True)
    )
    base = s.run_base[known[1]]
    true_step = np.hypot(*np.diff(base, axis=0).T)
    reported_step = np.hypot(*np.diff(path[:, :2], axis=0).T)
    if reported_step.sum() < _STANDING * s.run_m:
        return None, None, None
    scale = float(np.hypot(*(base[-1] - base[0])) / np.hypot(*(path[-1, :2] - path[0, :2])))
    parts = [
        float(true.sum() / max(reported.sum(), 1e-9))
        for true, reported in zip(np.array_split(true_step, _PARTS), np.array_split(reported_step, _PARTS), strict=True)
    ]
    turned = float(np.ptp(np.unwrap(turns[:, 2])))
    return (
        scale,
        float(np.std(parts, ddof=1) / np.sqrt(_PARTS)),
        float(np.ptp(s.spin[known[0], 2])) / turned if turned > _MIN_TURN_RAD else None,
    )
