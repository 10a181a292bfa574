"""Static tilt and ceiling height (eq. 5) from pictures of the ceiling's own grid."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.joint import refine
from ceilvo.calib.solve.lens import lens_of, reprojection, with_lens_error
from ceilvo.calib.solve.projection import Mounting
from ceilvo.calib.solve.tile_grid import Spacing, tile_index, tile_spacings
from ceilvo.calib.targets.ceiling_view import GridView
from ceilvo.calibration import mount_rotation
from ceilvo.calibration_check import HEIGHTS_M
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError
from ceilvo.robust import MAD_TO_SIGMA

Array = NDArray[np.float64]

_ROUGHLY = 1.1
"""Factor to which --height-m is known: a tape, to a tenth."""
_ON_GRID = 0.25
"""Fraction of the crossings that must be on the grid; chosen: lamps and vents may be the larger part."""
_SUPPORT = 0.35
"""Harmonic mean of crossings on the grid and nodes seen that a grid must have; chosen."""
_RIVAL = 0.8
"""Of the winner's support, from which the runner-up makes the answer doubtful (docs/calibration.md)."""
_HUBER = 3.0
"""Robust standard deviations beyond which a crossing counts linearly."""
_OUTLIER, _OUTLIER_PX = 5.0, 0.3
"""A crossing that is off by more does not belong: robust standard deviations, and px, which a good one may have."""
_MIN_CROSSINGS = 4
"""Left in a picture: a pose has three unknowns, a crossing two equations."""
_ROUNDS = 30
"""Least squares' steps at the most; from the lattice it is near."""


@dataclass(frozen=True)
class GridSample:
    """A picture's crossings on the lattice: index (K, 2) tiles, uv_px (K, 2), start (3,) in tiles and rad."""

    index: Array
    uv_px: Array
    start: Array


def grid_samples(views: list[GridView], tile_over_height: float) -> list[GridSample | None]:
    """For each picture its crossings on the lattice, None where too few are."""
    out: list[GridSample | None] = []
    for view in views:
        on_grid = tile_index(view, tile_over_height)
        if on_grid is None:
            out.append(None)
        else:
            out.append(GridSample(on_grid.index.astype(np.float64), view.uv_px[on_grid.used], on_grid.xy_yaw))
    return out


def from_grid(
    camera: CameraModel,
    views: list[GridView],
    tile_m: float,
    tilt_rad: tuple[float, float],
    intrinsics_cov: Array | None = None,
    height_m: float | None = None,
) -> tuple[Mounting, Array]:
    """Static tilt and height from pictures of a tiled ceiling; also (V, 3) each camera pose in its picture's lattice.

    Args:
        tile_m: side of a tile.
        tilt_rad: roll, pitch to start from.
        intrinsics_cov: of the lens, which is then refined on the grid; None = the lens is taken as exact.
        height_m: of the ceiling above the camera as far as known, to within a tenth; None = anything.

    Raises:
        CalibrationError: the crossings are not regular, or in two ways.
    """
    tile_over_height, evidence = _decided(views, tile_m, height_m)
    samples = [s for s in grid_samples(views, tile_over_height) if s is not None]
    if not samples:
        raise CalibrationError("projection: found no picture with six crossings on the grid; take others")
    start = np.array([*tilt_rad, tile_m / tile_over_height])
    fit, samples = _grid_fit(camera, samples, tile_m, start)

    def of_lens(other: CameraModel) -> bundle.Residuals:
        return grid_residuals(other, samples, tile_m)

    cov, level, joint = bundle.widest(fit), fit.shared, None
    if intrinsics_cov is not None and np.linalg.matrix_rank(intrinsics_cov) == len(intrinsics_cov):
        joint = refine(camera, intrinsics_cov, of_lens, fit, _shared_errors(samples))
    if joint is not None and joint.agrees:
        fit, cov, level = joint.fit, joint.level_cov, joint.level
    elif intrinsics_cov is not None and (lens := lens_of(camera)) is not None:
        moves, _ = bundle.response(lambda p: of_lens(lens[0](p)), lens[1], fit.shared, fit.views)
        cov = with_lens_error(cov, moves, intrinsics_cov)
    residual = np.concatenate(fit.residuals).reshape(-1, 2)
    uv = np.concatenate([s.uv_px for s in samples])
    roll, pitch, height = (float(v) for v in level)
    found = Mounting(roll, pitch, height, None, None, cov, residual, uv, fit.rms, tile_m, evidence, joint)
    return found, fit.views


def _decided(views: list[GridView], tile_m: float, height_m: float | None) -> tuple[float, str]:
    """Tile over height, and what speaks for it.

    Raises:
        CalibrationError: nothing does, it speaks for another as well, or what the tape says is not what it speaks for.
    """
    any_height = tile_spacings(views, (tile_m / HEIGHTS_M[1], tile_m / HEIGHTS_M[0]))
    found = any_height
    if height_m is not None:
        low, high = height_m / _ROUGHLY, height_m * _ROUGHLY
        found = tile_spacings(views, (tile_m / high, tile_m / low))
    best = found[0] if found else Spacing(tile_m, 0.0, 0.0)
    most = any_height[0] if any_height else best
    if height_m is not None and _stands(most) and best.support < _RIVAL * most.support:
        there_m = tile_m / most.tile_over_height
        raise CalibrationError(
            f"projection: the tile of {tile_m:g} m and the height by tape disagree: tiles of that side put the ceiling "
            f"at {there_m:.2f} m above the camera, the tape says {height_m:.2f} m, at which a tile has "
            f"{tile_m * height_m / there_m:.3f} m; measure ten tiles in a row, joint to joint, and the height once more"
        )
    said = "" if height_m is None else f" for a ceiling {height_m:g} m above the camera, give or take a tenth"
    if not _stands(best):
        raise CalibrationError(
            f"projection: found no grid of square tiles of {tile_m:g} m{said}: {100 * best.on_grid:.0f} % of the "
            f"crossings are on the best one, {100 * _ON_GRID:.0f} needed, {100 * best.filled:.0f} % of its nodes seen; "
            "is the ceiling tiled, is the tile's size right? Fewer lamps and vents elsewhere? Or measure --points"
        )
    evidence = f"{100 * best.on_grid:.0f} % of the crossings are on it, {100 * best.filled:.0f} % of its nodes seen"
    if len(found) == 1:
        return best.tile_over_height, evidence
    rival = found[1]
    height_of_best_m, height_of_rival_m = tile_m / best.tile_over_height, tile_m / rival.tile_over_height
    if rival.support > _RIVAL * best.support:
        raise CalibrationError(
            f"projection: found two grids that fit, of a ceiling {height_of_best_m:.2f} m above the camera "
            f"(support {best.support:.2f}) and {height_of_rival_m:.2f} m ({rival.support:.2f}); "
            "measure it with a tape and pass --height-m"
        )
    return best.tile_over_height, evidence + (
        f"; the next best, of a ceiling at {height_of_rival_m:.2f} m, has "
        f"{rival.support / best.support:.2f} of the support"
    )


def _stands(s: Spacing) -> bool:
    return s.on_grid >= _ON_GRID and s.support >= _SUPPORT


def _shared_errors(samples: list[GridSample]) -> float:
    """Coordinates of crossings for each joint, which gives one error to all that are on it."""
    joints = sum(len(np.unique(s.index[:, k])) for s in samples for k in (0, 1))
    return 2.0 * sum(len(s.index) for s in samples) / joints


def _grid_fit(
    camera: CameraModel, samples: list[GridSample], tile_m: float, start: Array
) -> tuple[bundle.BundleFit, list[GridSample]]:
    """Robust first, then without the crossings that do not belong."""
    views = np.array([[s.start[0] * tile_m, s.start[1] * tile_m, s.start[2]] for s in samples])
    fit = _grid_solve(camera, samples, tile_m, start, views, rounds=_ROUNDS, huber=_HUBER)
    noise = MAD_TO_SIGMA * float(np.median(np.abs(np.concatenate(fit.residuals))))
    clean = []
    for sample, r in zip(samples, fit.residuals, strict=True):
        good = (np.abs(r.reshape(-1, 2)) < max(_OUTLIER * noise, _OUTLIER_PX)).all(axis=1)
        clean.append(replace(sample, index=sample.index[good], uv_px=sample.uv_px[good]))
    keep = [i for i, s in enumerate(clean) if len(s.index) >= _MIN_CROSSINGS]
    clean = [clean[i] for i in keep]
    return _grid_solve(camera, clean, tile_m, fit.shared, fit.views[keep], rounds=_ROUNDS), clean


def _grid_solve(
    camera: CameraModel,
    samples: list[GridSample],
    tile_m: float,
    shared: Array,
    views: Array,
    rounds: int,
    huber: float | None = None,
) -> bundle.BundleFit:
    return bundle.solve(grid_residuals(camera, samples, tile_m), shared, views, rounds=rounds, huber=huber)


def grid_residuals(camera: CameraModel, samples: list[GridSample], tile_m: float) -> bundle.Residuals:
    """Of all pictures, as the bundle takes them."""

    def residuals(i: int, p: Array, view: Array) -> Array:
        return grid_residual(camera, samples[i], tile_m, p, view)

    return residuals


def grid_residual(camera: CameraModel, sample: GridSample, tile_m: float, shared: Array, view: Array) -> Array:
    """Pixels; shared: roll, pitch, height; view: the camera's x, y in the lattice (m) and heading."""
    xyz = np.column_stack([sample.index * tile_m - view[:2], np.full(len(sample.index), shared[2])])
    rays = xyz @ mount_rotation(view[2], shared[0], shared[1]).T
    return reprojection(camera, rays, sample.uv_px)
