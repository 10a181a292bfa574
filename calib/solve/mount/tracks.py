"""The camera's path through the ceiling's grid: each picture's own pose, then all poses in one lattice."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.grid import GridSample, grid_residual, grid_residuals, grid_samples
from ceilvo.calib.targets.ceiling_view import GridView
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError
from ceilvo.robust import MAD_TO_SIGMA

Array = NDArray[np.float64]

SPIN, RUN = "spin", "run"
"""The two parts of the experiment, also the names of the folders that recorded pictures lie in."""
MIN_PICTURES = 12
"""Of each part; chosen: with fewer the residuals of the blocks say too little about sigma."""
MOST_PICTURES = 45
"""That tilt and height are refined on; chosen: more cost time and change neither, they are common to all."""
_HUBER = 2.0
"""Robust standard deviations beyond which a crossing counts linearly."""
_ROUNDS_LEVEL, _ROUNDS_ROBUST, _ROUNDS_CLEAN = 12, 10, 6
"""Least squares' steps at the most; they start near, from the lattice, and usually end sooner."""
_OUTLIER, _OUTLIER_PX = 4.0, 0.3
"""A crossing that is off by more does not belong: robust standard deviations, and px, which a good one may have."""
_MIN_CROSSINGS = 4
"""Left in a picture: a pose has three unknowns, a crossing two equations."""


@dataclass(frozen=True)
class MountPicture:
    """One picture of the experiment: SPIN or RUN, what it shows, the wheels' cumulative pose if known."""

    label: str
    view: GridView
    wheels: Array | None = None


@dataclass(frozen=True)
class Track:
    """Samples of one part that are on the grid, and which of its pictures they are."""

    samples: list[GridSample]
    rows: list[int]


def samples_of(part: list[MountPicture], tile_over_height: float) -> Track:
    rows, samples = [], []
    for i, s in enumerate(grid_samples([p.view for p in part], tile_over_height)):
        if s is not None:
            rows.append(i)
            samples.append(s)
    if len(samples) < MIN_PICTURES:
        raise CalibrationError(
            f"mount: found the grid in {len(samples)} of {len(part)} pictures of the {part[0].label}, "
            f"{MIN_PICTURES} needed; stay under a regular part of the ceiling"
        )
    return Track(samples, rows)


def thinning(every: list[GridSample]) -> int:
    """One picture in so many, that there are MOST_PICTURES at the most."""
    return max(1, -(-len(every) // MOST_PICTURES))


def refine_level(camera: CameraModel, tracks: list[Track], tile_m: float, level: Array) -> Array:
    """(3,) roll, pitch and height from a part of the pictures."""
    every = [s for t in tracks for s in t.samples]
    some = every[:: thinning(every)]
    starts = np.array([[*(s.start[:2] * tile_m), s.start[2]] for s in some])
    return bundle.solve(grid_residuals(camera, some, tile_m), level, starts, huber=_HUBER, rounds=_ROUNDS_LEVEL).shared


def poses(
    camera: CameraModel, samples: list[GridSample], tile_m: float, level: Array
) -> tuple[Array, list[GridSample]]:
    """(N, 3) camera in each picture's own lattice, and the samples without crossings that do not belong to it."""
    out, clean = np.zeros((len(samples), 3)), []
    for i, sample in enumerate(samples):
        start = np.array([[*(sample.start[:2] * tile_m), sample.start[2]]])
        residuals = partial(_lattice_off, camera, sample, tile_m, level)
        fit = bundle.solve(residuals, np.zeros(0), start, huber=_HUBER, rounds=_ROUNDS_ROBUST)
        off = np.abs(fit.residuals[0].reshape(-1, 2)).max(axis=1)
        good = off < max(_OUTLIER * MAD_TO_SIGMA * float(np.median(off)), _OUTLIER_PX)
        kept, out[i] = sample, fit.views[0]
        if np.count_nonzero(good) >= _MIN_CROSSINGS and not good.all():
            kept = replace(sample, index=sample.index[good], uv_px=sample.uv_px[good])
        residuals = partial(_lattice_off, camera, kept, tile_m, level)
        out[i] = bundle.solve(residuals, np.zeros(0), out[i][None], rounds=_ROUNDS_CLEAN).views[0]
        clean.append(kept)
    return out, clean


def _lattice_off(
    camera: CameraModel, sample: GridSample, tile_m: float, level: Array, _: int, __: Array, view: Array
) -> Array:
    return grid_residual(camera, sample, tile_m, level, view)


def continuous(own: Array, tile_m: float) -> Array:
    """The poses in one lattice: what a picture cannot tell is which tile it is, and which quarter turn."""
    out: Array = own.copy()
    velocity = np.zeros(2)
    for i in range(1, len(out)):
        out[i] = _nearest(own[i], out[i - 1], velocity, tile_m)
        velocity = out[i, :2] - out[i - 1, :2]
    return out


def _nearest(pose: Array, before: Array, velocity: Array, tile_m: float) -> Array:
    """The pose in the lattice of the picture before."""
    quarter = np.round((before[2] - pose[2]) / (0.5 * np.pi))
    xy = se2.rotation(0.5 * np.pi * float(quarter)) @ pose[:2]
    xy += np.round((before[:2] + velocity - xy) / tile_m) * tile_m
    return np.array([*xy, pose[2] + quarter * 0.5 * np.pi])
