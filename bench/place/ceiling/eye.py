"""A fast eye: crossings as the camera and the crossing finder would give them, made from the true ceiling.

It errs as they do: by the line, for a line that is missed or called something else takes all its crossings with it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.bench.place.ceiling.truth import PX_M, Features, Origin
from ceilvo.calibration import Calibration
from ceilvo.crossing_types import crossing_type_of, quarter_turns, turned_type
from ceilvo.daemon.vision.crossings import to_ceiling
from ceilvo.se2 import rotation
from ceilvo.types import Array, Crossings, Ints, LineKind

_QUARTER = 0.5 * np.pi
_FEWEST = 2
"""With fewer crossings in view there is no common direction; chosen."""
_APART_M = 0.03
"""False crossings are at least so far from true ones; chosen: nearer ones would be the same feature."""


@dataclass(frozen=True)
class EyeNoise:
    """How the finder errs on rendered frames, by `python -m ceilvo.bench.place eye-check` (500 frames each of the rooms
    of seeds 3 and 5, before this eye was set by them).

    Attributes:
        line_px: (4,) standard deviation of a line's offset in one frame, by Origin: .03, 1.0 (of which most is the
            same in every frame: a lamp seems larger than it is) and .02; .3 is chosen for lamps and vents.
        outlier, outlier_px: share of lines that are further off, and how far: all together .124 px for the grid.
        psi_rad: of the common direction: .02 mrad.
        tilt_rad: of the camera's tilt as estimated, which shifts all crossings: .13 mm; it wanders, tilt_keeps a frame.
        line_missed: (4,) share of lines with 3 crossings or more that are missed in a frame, by Origin: .2 %, 1.7 %,
            3.2 %; missed_again: that it is missed in the next one as well: 45 to 100 %.
        missed_most: (4,) every crossing has a share of its own of frames in which it is missed, evenly from 0 to this
            one: recall 97.8 % of the grid, 90.5 % of lamps, 52 % of vents, with every share from 0 to 1 among them.
        confused: share of the edges of lamps that are called grooves, as their rim is narrow: 15 %.
        clutter: false crossings a frame that are nowhere twice: .6. Of the other 5 a frame that the true lines do not
            explain (88 % of them keep their places, beside lamps and diffusers) this eye knows nothing.
        border_px: crossings nearer the picture's border are not found; chosen: some 10 px of an arm must be seen.
    """

    line_px: tuple[float, ...] = (0.03, 0.3, 0.3, 0.3)
    outlier: float = 0.03
    outlier_px: float = 0.7
    psi_rad: float = 2e-5
    tilt_rad: float = 6e-5
    tilt_keeps: float = 0.85
    line_missed: tuple[float, ...] = (0.002, 0.017, 0.03, 0.02)
    missed_again: float = 0.5
    missed_most: tuple[float, ...] = (0.035, 0.15, 0.95, 0.15)
    confused: float = 0.15
    clutter: float = 0.6
    border_px: float = 10.0


@dataclass
class Sight:
    """What is the matter with the eye or with what hangs in front of it; as it is: nothing.

    Attributes:
        scale: of all distances, as under a ceiling of another height.
        yaw_rad: by which the camera was turned on the robot since it was calibrated.
        shift_m: (2,) by which all crossings are shifted, as by a tilt that is not estimated.
        recall: share of the crossings that are left.
        blind: origins of which nothing is seen.
        hidden: (K, 3) discs x, y, radius in base that hide what is above them.
        ghosts_m: (G, 2) crossings in base that move with the robot, as dirt on the lens does.
    """

    scale: float = 1.0
    yaw_rad: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)
    recall: float = 1.0
    blind: tuple[int, ...] = ()
    hidden: Array = field(default_factory=lambda: np.zeros((0, 3)))
    ghosts_m: Array = field(default_factory=lambda: np.zeros((0, 2)))


PLAIN = Sight()
"""Nothing the matter."""


class SyntheticEye:
    """Crossings from a true pose; half a millisecond a frame at most, whatever the size of the ceiling."""

    def __init__(
        self, features: Features, calibration: Calibration, rng: np.random.Generator, noise: EyeNoise | None = None
    ) -> None:
        self.features = features
        self._calibration, self._rng, self._noise = calibration, rng, noise or EyeNoise()
        self._line_px = np.array(self._noise.line_px)
        self._line_missed = np.array(self._noise.line_missed)
        most = np.array(self._noise.missed_most)[features.feature_origin]
        self.missed = most * np.random.default_rng(len(features)).random(len(features))
        self._tilt = np.zeros(2)
        self._gone = np.zeros(len(features.origin), bool)
        self._size = np.array([calibration.camera.width_px, calibration.camera.height_px]) - 1.0
        corners = self._size * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
        far = to_ceiling(calibration.ceiling_from_level, calibration.level_view.from_raw(corners))
        self.reach_m = float(np.hypot(*(far - calibration.mount_xy_m).T).max())

    def look(self, pose: Array, sight: Sight = PLAIN) -> Crossings | None:
        """Crossings from map_from_base (3,), None where there are too few for a direction."""
        which, xy = self._in_view(pose, sight)
        if len(which) < _FEWEST:
            return None
        direction = self.features.axis_rad - float(pose[2]) - sight.yaw_rad  # of axis 0 in base
        normals = rotation(direction).T  # rows
        keep, errors_m, sigma_m, kinds = self._lines(self.features.line[which])
        keep &= self._rng.random(len(keep)) < sight.recall * (1.0 - self.missed[which])
        xy = xy + errors_m @ normals
        xy, sigma_m, kinds = self._with_false(xy[keep], sigma_m[keep], kinds[keep], normals, sight)
        if len(xy) < _FEWEST:
            return None
        xy = xy + self._wandering() + sight.shift_m
        psi = float((direction + 0.5 * _QUARTER) % _QUARTER - 0.5 * _QUARTER)
        kind = turned_type(crossing_type_of(kinds[:, 0], kinds[:, 1]), quarter_turns(direction, psi))
        return self._crossings(xy, sigma_m, kind, normals, psi + self._noise.psi_rad * self._rng.standard_normal())

    def _in_view(self, pose: Array, sight: Sight) -> tuple[Ints, Array]:
        """Which crossings are in the picture and not hidden, and (M, 2) where they seem to be in base."""
        f, mount = self.features, self._calibration.mount_xy_m
        near = f.near(pose[:2], self.reach_m / min(sight.scale, 1.0) + float(np.hypot(*mount)))
        base = (f.xy_map_m[near] - pose[:2]) @ rotation(float(pose[2]))
        seems = sight.scale * (base - mount) @ rotation(sight.yaw_rad) + mount
        seen = np.hypot(*(seems - mount).T) < self.reach_m
        near, base, seems = near[seen], base[seen], seems[seen]
        raw = self._calibration.level_view.to_raw(self._level(seems))
        border = self._noise.border_px
        seen = np.all((raw > border) & (raw < self._size - border), axis=1)
        if sight.blind:
            seen &= ~np.isin(f.origin[f.line[near]], sight.blind).any(axis=1)
        for x, y, radius in sight.hidden:
            seen &= np.hypot(base[:, 0] - x, base[:, 1] - y) > radius
        return near[seen], seems[seen]

    def _level(self, xy_base_m: Array) -> Array:
        """(M, 2) level pixels."""
        s = np.column_stack([xy_base_m, np.ones(len(xy_base_m))]) @ self._calibration.level_from_ceiling.T
        return np.asarray(s[:, :2] / s[:, 2:])

    def _lines(self, line: Ints) -> tuple[NDArray[np.bool_], Array, Array, Ints]:
        """Of crossings of lines (M, 2): whether found, and (M, 2) error, its sigma and LineKind along both normals."""
        noise, rng, f = self._noise, self._rng, self.features
        ids, index = np.unique(line, return_inverse=True)
        index = index.reshape(line.shape)
        origin = f.origin[ids]
        share = self._line_missed[origin]
        first = share * (1.0 - noise.missed_again) / (1.0 - share)
        missed = rng.random(len(ids)) < np.where(self._gone[ids], noise.missed_again, first)
        self._gone[:] = False
        self._gone[ids[missed]] = True
        sigma_m = PX_M * self._line_px[origin]
        far = rng.random(len(ids)) < noise.outlier
        error = np.where(far, PX_M * noise.outlier_px, sigma_m) * rng.standard_normal(len(ids))
        confused = (origin == Origin.LAMP) & (rng.random(len(ids)) < noise.confused)
        kind = np.where(confused, LineKind.GROOVE, f.kind[ids])
        return np.asarray(~missed[index].any(axis=1)), error[index], sigma_m[index], kind[index]

    def _with_false(
        self, xy: Array, sigma_m: Array, kinds: Ints, normals: Array, sight: Sight
    ) -> tuple[Array, Array, Ints]:
        """With crossings of lines that do not meet there, and with what moves with the robot."""
        count = int(self._rng.poisson(self._noise.clutter)) if len(xy) else 0
        if count:
            a, b = self._rng.integers(len(xy), size=(2, count))
            along = xy @ normals.T
            false = np.column_stack([along[a, 0], along[b, 1]]) @ normals
            new = np.hypot(*(false[:, None] - xy[None]).transpose(2, 0, 1)).min(axis=1) > _APART_M
            a, b = a[new], b[new]
            xy = np.concatenate([xy, false[new]])
            sigma_m = np.concatenate([sigma_m, np.column_stack([sigma_m[a, 0], sigma_m[b, 1]])])
            kinds = np.concatenate([kinds, np.column_stack([kinds[a, 0], kinds[b, 1]])])
        if len(sight.ghosts_m):
            ghosts = sight.ghosts_m
            xy = np.concatenate([xy, ghosts])
            sigma_m = np.concatenate([sigma_m, np.full((len(ghosts), 2), PX_M * self._line_px[0])])
            kinds = np.concatenate([kinds, np.full((len(ghosts), 2), LineKind.GROOVE)])
        return xy, sigma_m, kinds

    def _wandering(self) -> Array:
        """(2,) shift by the error of the estimated tilt, m."""
        keeps = self._noise.tilt_keeps
        new = np.sqrt(1.0 - keeps**2) * self._noise.tilt_rad * self._rng.standard_normal(2)
        self._tilt = keeps * self._tilt + new
        return np.asarray(self._tilt * self._calibration.ceiling_height_m)

    def _crossings(self, xy: Array, sigma_m: Array, kind: Ints, normals: Array, psi: float) -> Crossings:
        tilt_sigma = np.full(2, self._noise.tilt_rad)
        common = np.diag((self._calibration.ceiling_height_m * tilt_sigma) ** 2)
        return Crossings(
            uv_px=self._level(xy),
            xy_base_m=xy,
            cov_base_m2=np.einsum("mk,ki,kj->mij", sigma_m**2, normals, normals) + common,
            crossing_type=kind,
            psi_rad=psi,
            psi_sigma_rad=self._noise.psi_rad,
            tilt_rad=np.zeros(2),
            tilt_sigma_rad=tilt_sigma,
            common_cov_m2=common,
        )
