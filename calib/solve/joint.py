"""The lens once more, now on the ceiling's grid: what the board left open shows as a ceiling that is not plane.

The board's lens with its covariance is the prior; pictures of the grid add to it. A grid that contradicts the board is
not believed: tiles may be uneven or sag, a board is what was measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.lens import lens_of
from ceilvo.camera import CameraModel

Array = NDArray[np.float64]

LensResiduals = Callable[[CameraModel], bundle.Residuals]

_LITTLE = 1e-3
"""Weight of the board's lens while the grid's own noise is found: only so much that no parameter is free."""
AGREES = 3.0
"""Mean square by which the parameters may move, in the board's sigma; of nine, one in seven hundred moves more."""


@dataclass(frozen=True)
class Joint:
    """Lens and level from board and grid.

    Attributes:
        camera, lens_cov: (K, K) of its parameters.
        level: (3,) roll, pitch, height; level_cov: (3, 3), the lens' part in it.
        moved: mean square of the lens' move in the board's sigma; agrees: whether that is credible.
        fit: of the grid's pixels.
    """

    camera: CameraModel
    lens_cov: Array
    level: Array
    level_cov: Array
    moved: float
    fit: bundle.BundleFit

    @property
    def agrees(self) -> bool:
        return self.moved <= AGREES


def refine(
    camera: CameraModel,
    lens_cov: Array,
    of_lens: LensResiduals,
    level: bundle.BundleFit,
    shared_errors: float = 1.0,
    rounds: int = 15,
) -> Joint | None:
    """Lens and level together, from the level found with the board's lens; None for a lens that is none of calib's.

    Args:
        lens_cov: (K, K) of the board's lens.
        of_lens: residuals of the grid's pixels, of any camera.
        shared_errors: how many residuals err together; a joint's error is in all of its crossings.
    """
    lens = lens_of(camera)
    if lens is None:
        return None
    make, start = lens[0], np.concatenate([level.shared, lens[1]])
    board = np.linalg.inv(lens_cov)
    info = np.zeros((len(start), len(start)))
    info[3:, 3:] = board * _LITTLE * level.rms**2

    def residuals(i: int, p: Array, view: Array) -> Array:
        return of_lens(make(p[3:]))(i, p[:3], view)

    free = bundle.solve(residuals, start, level.views, prior_info=info, rounds=rounds)  # its rms is the grid's noise
    info[3:, 3:] = board * free.rms**2 * shared_errors
    fit = bundle.solve(residuals, start, free.views, prior_info=info, rounds=rounds)
    cov = bundle.at_least(fit.cov * shared_errors, fit.cluster_cov)
    move = fit.shared[3:] - start[3:]
    return Joint(
        make(fit.shared[3:]), cov[3:, 3:], fit.shared[:3], cov[:3, :3], float(move @ board @ move) / len(move), fit
    )
