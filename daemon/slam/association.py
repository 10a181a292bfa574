"""From crossings to observations of the map: noise of eqs. 26-27, kinds in the map's quadrant, association."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from ceilvo.calibration import NoiseCurves
from ceilvo.config import Filter
from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.odometry.matching import Near, mutual_nearest
from ceilvo.se2 import rotation, transform, wrap
from ceilvo.types import NO_LANDMARK, UNLABELLED, Array, Crossings, Ints, Observations, frozen

SIGMA_FLOOR_M = 1e-4
"""No curve is trusted below this."""
VAR_FLOOR = 1e-12
"""m^2 or rad^2: smaller variances are not believed; a micrometre, squared."""
NIS_CAP = 50.0
"""Largest normalised innovation squared of one feature in a mean: a few false matches are not a lost robot."""
OUTLIER_DENSITY_PER_M2 = 0.25
"""An outlier may lie anywhere on 4 m^2; chosen."""
CANDIDATE_GATE_CHI2 = 25.0
"""Squared normalised distance at which two sightings cannot be of one feature (5 sigma)."""
DUPLICATE_FRACTION = 0.25
"""No landmark is born nearer to one of its kind than this fraction of the association gate."""
SHARP_GATE_M, SHARP_SIGMAS = 0.05, 4.0
"""Under a ceiling of several heights a landmark is no further off, where the pose is known to a quarter of that: what
was learnt before a height was known lies beside the right one, centimetres or decimetres off; chosen."""
EXPIRES_UPDATES = 20
"""A feature seen too rarely and not again for so many updates is forgotten; chosen."""
MOST_FEATURES = 64
"""Of one view that a filter is updated with, and that are born of it, whatever it shows; chosen: the golden drives show
26 to 81, half of them more than 58 on the lap, and more of one view say little more (K features count as K^0.5)."""
_GRID = 257
"""Samples of a noise curve between its radii; 256 steps over 3 m are 12 mm each."""
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def sigma(curves: NoiseCurves, r_m: Array) -> tuple[Array, Array]:
    """sigma_x, sigma_y [m] at distances r_m (any shape) from the point below the camera (eqs. 26-27).

    Inside [r_min, r_max] the running maximum of the polynomials, so that a dip of the fit never makes a farther
    feature more certain; held below r_min, growing in proportion to r above r_max.
    """
    grid, table_x, table_y = _tables(curves)
    r = np.asarray(r_m, np.float64)
    beyond = np.maximum(r / grid[-1], 1.0) if grid[-1] > 0 else np.ones_like(r)
    return np.interp(r, grid, table_x) * beyond, np.interp(r, grid, table_y) * beyond


@lru_cache(maxsize=8)
def _tables(curves: NoiseCurves) -> tuple[Array, Array, Array]:
    grid = np.linspace(max(curves.r_min_m, 0.0), max(curves.r_max_m, curves.r_min_m, 0.0), _GRID)
    x, y = curves.at(grid)
    return (
        frozen(grid),
        frozen(np.maximum.accumulate(np.maximum(x, SIGMA_FLOOR_M))),
        frozen(np.maximum.accumulate(np.maximum(y, SIGMA_FLOOR_M))),
    )


def associate(
    crossings: Crossings,
    curves: NoiseCurves,
    mount_xy_m: Array,
    pose: Array,
    near: Near,
    settings: Filter,
    map_axis_rad: float,
    visible_m: Array | None = None,
    pose_cov: Array | None = None,
) -> Observations:
    """Observations of one frame, labelled with the landmarks (their index) that explain them, else -1.

    Args:
        crossings: features of the frame, in base.
        curves: noise of commissioning; the crossings' own covariance is added to it.
        mount_xy_m: (2,) camera in base, where r is counted from.
        pose: (3,) predicted map_from_base.
        near: of the map, see PoseFilter.landmarks_near.
        settings: association_gate_m is used.
        map_axis_rad: direction of the ceiling's lines in the map, modulo 90 deg.
        visible_m: (V, 2) as in Observations; None: not known.
        pose_cov: (3, 3), for crossings of several heights.
    """
    turns = quarter_turns(crossings.psi_rad + float(pose[2]), map_axis_rad)
    kind = turned_type(crossings.crossing_type, turns)
    sigma_x, sigma_y = sigma(curves, np.hypot(*(crossings.xy_base_m - mount_xy_m).T))
    variance = np.column_stack([sigma_x**2, sigma_y**2])  # R11, R22 of eq. 27, as variances
    variance += np.diagonal(crossings.cov_base_m2, axis1=1, axis2=2)
    seen_at = transform(pose, crossings.xy_base_m)
    reach_m = _reach_m(crossings, pose_cov)
    return Observations(
        xy_base_m=crossings.xy_base_m,
        var_m2=frozen(variance),
        crossing_type=kind,
        label=_associate(seen_at, kind, near, min(settings.association_gate_m, reach_m)),
        heading_rad=wrap(map_axis_rad - crossings.psi_rad - 0.5 * np.pi * turns),
        heading_var_rad2=curves.sigma_theta_rad**2 + crossings.psi_sigma_rad**2,  # R33 of eq. 27
        common_var_m2=0.5 * float(np.trace(crossings.common_cov_m2)),
        visible_m=np.empty((0, 2)) if visible_m is None else visible_m,
        reach_m=reach_m,
    )


def _reach_m(crossings: Crossings, pose_cov: Array | None) -> float:
    if not crossings.several or pose_cov is None:
        return float("inf")
    return max(SHARP_SIGMAS * float(np.sqrt(np.max(np.diag(pose_cov)[:2]))), SHARP_GATE_M)


def _associate(xy_map_m: Array, kind: Ints, near: Near, gate_m: float) -> Ints:
    labels, there = near(xy_map_m, gate_m)
    seen, which = mutual_nearest(xy_map_m, kind, there.xy_map_m, there.crossing_type, gate_m)
    label = np.full(len(kind), NO_LANDMARK, np.int64)
    label[seen] = labels[which]
    return label


def usable(obs: Observations, landmarks: int) -> Observations:
    """Without rows that are not finite or have no variance; a landmark seen twice or not there is unknown."""
    good = np.all(np.isfinite(obs.xy_base_m), axis=1) & np.all(np.isfinite(obs.var_m2) & (obs.var_m2 > 0.0), axis=1)
    label = obs.label[good].copy()
    label[(label >= landmarks) | (label < UNLABELLED)] = NO_LANDMARK
    first = np.unique(label, return_index=True)[1]
    repeated = label >= 0
    repeated[first] = False
    label[repeated] = NO_LANDMARK
    return replace(
        obs.of(good),
        var_m2=np.maximum(obs.var_m2[good], VAR_FLOOR),
        label=label,
        common_var_m2=obs.common_var_m2 if np.isfinite(obs.common_var_m2) else 0.0,
    )


def spread_out(xy_m: Array, most: int, turn: int) -> Ints:
    """So many of the points (N, 2) at most, in order, evenly over where they are; another turn takes others.

    They are passed along in strips, to and fro, and every n-th is taken; what is left out takes its turn. Golden
    sections of a step come near every point soonest.
    """
    if len(xy_m) <= most:
        return np.arange(len(xy_m))
    if most <= 0:
        return np.empty(0, np.int64)
    low, size = np.min(xy_m, axis=0), np.maximum(np.ptp(xy_m, axis=0), SIGMA_FLOOR_M)
    strips = max(round(np.sqrt(most * size[0] / size[1])), 1)
    strip = np.minimum(np.floor((xy_m[:, 0] - low[0]) / size[0] * strips), strips - 1)
    along = np.where(strip % 2, -xy_m[:, 1], xy_m[:, 1])
    step = len(xy_m) / most
    at = (np.arange(most) + turn * _GOLDEN % 1.0) * step
    return np.sort(np.lexsort((along, strip))[at.astype(np.int64)])


def bounded(obs: Observations, turn: int) -> Observations:
    """So many of the features with a landmark, and of those without, as a filter is updated with."""
    parts = np.flatnonzero(obs.label >= 0), np.flatnonzero(obs.label < 0)
    return obs.of(np.sort(np.concatenate([p[spread_out(obs.xy_base_m[p], MOST_FEATURES, turn)] for p in parts])))


def near_landmarks(seen: Observations, pose: Array, pose_cov: Array, at: Array, cov: Array) -> Array:
    """(K,) squared normalised distances of features to landmarks at (K, 2) with cov (K, 2, 2), the pose as uncertain.

    What pose and landmarks have in common is not known here: the distances are rather too small.
    """
    r = rotation(float(pose[2]))
    arm = seen.xy_base_m @ r.T
    own = cov + np.asarray((r * seen.var_m2[:, None, :]) @ r.T, np.float64)
    lever = np.zeros((len(arm), 2, 3))
    lever[:, 0, 0] = lever[:, 1, 1] = 1.0
    lever[:, 0, 2], lever[:, 1, 2] = -arm[:, 1], arm[:, 0]
    return chi2_of(pose[:2] + arm - at, own + lever @ pose_cov @ lever.transpose(0, 2, 1))


def chi2_of(nu: Array, own: Array) -> Array:
    """(K,) of innovations (K, 2) with covariances (K, 2, 2)."""
    det = own[:, 0, 0] * own[:, 1, 1] - own[:, 0, 1] ** 2
    x, y = nu[:, 0], nu[:, 1]
    return np.asarray((own[:, 1, 1] * x * x - 2.0 * own[:, 0, 1] * x * y + own[:, 0, 0] * y * y) / det, np.float64)


def independent(features: int, power: float, correlation: float) -> float:
    """How many independent features K features of one frame are worth.

    K crossings are made of far fewer lines, so they count as K^power; of those a share `correlation` of the variance
    is common to all, which leaves n / (1 + (n - 1) correlation) (Kish's design effect).
    """
    n = float(features**power)
    return n / (1.0 + max(n - 1.0, 0.0) * min(max(correlation, 0.0), 1.0))
