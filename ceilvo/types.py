"""The quantities that flow through the pipeline: frozen, float64, arrays read-only by convention.

Frames of reference (docs/coordinates.md): base (x forward, y left, z up), map (fixed to the room), level view
(pixels of a virtual camera that stands where the real one does, looks straight up and has its axes along base's).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from types import MappingProxyType
from typing import NewType

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CeilingLines

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

Pose = NewType("Pose", NDArray[np.float64])
"""(3,) [m, m, rad]: where one frame of reference is in another, map_from_base unless said otherwise."""
Displacement = NewType("Displacement", NDArray[np.float64])
"""(3,) [m, m, rad]: prev_from_curr, how a frame of reference moved in an interval."""
Twist = NewType("Twist", NDArray[np.float64])
"""(3,) [m/s, m/s, rad/s] in base."""

NO_DIRECTION_RAD = float(np.pi / np.sqrt(48.0))
"""Standard deviation of a direction that nothing tells: any within a quarter turn is as likely."""


class LineKind(IntEnum):
    """What a line is, along its normal: brightness rises, falls, or a groove (both, close together)."""

    FALLING = -1
    GROOVE = 0
    RISING = 1


class State(IntEnum):
    """How far the pose can be trusted; the numbers are on the wire."""

    INIT = 0
    TRACKING = 1
    DEGRADED = 2
    DEAD_RECKONING = 3
    LOST = 4
    RELOCALISING = 5
    STOPPED = 6


GOOD = (State.TRACKING, State.DEGRADED)  # the ceiling says where the robot is


@dataclass(frozen=True, slots=True)
class Frame:
    """One grey image; stamp_ns is the camera's own, CLOCK_MONOTONIC."""

    seq: int
    stamp_ns: int
    gray: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Lines:
    """Straight lines n . uv = offset in the level view; all share one direction modulo 90 deg.

    Lines of axis 0 have their normal n at psi, those of axis 1 at psi + 90 deg.

    Attributes:
        psi_rad, psi_sigma_rad: dominant direction in base, in [-pi/4, pi/4), and its standard deviation.
        axis: (L,) 0 or 1.
        offset_px, sigma_px: (L,) distance from the level view's principal point along the normal, and its sigma.
        kind: (L,) LineKind.
        support: (L,) edge points in the fit.
        tilt_rad, tilt_sigma_rad: (2,) rotation of the camera about base x and y against its calibration, and sigma.
        free_tilt_rad, free_tilt_sigma_rad: (2,) the same from this frame alone.
        points: (P, 2) px, edge points in the level view that support a line, for pictures and coverage checks.
        point_line: (P,) index of their line.
        fraction: of the edge points there are, how many were looked at.
        uniform: those stand at even distances along their lines, not anywhere.
    """

    psi_rad: float
    psi_sigma_rad: float
    axis: Ints
    offset_px: Array
    sigma_px: Array
    kind: Ints
    support: Ints
    tilt_rad: Array
    tilt_sigma_rad: Array
    free_tilt_rad: Array
    free_tilt_sigma_rad: Array
    points: NDArray[np.float32]
    point_line: Ints
    fraction: float = 1.0
    uniform: bool = False


@dataclass(frozen=True, slots=True)
class Crossings:
    """Point features: crossings of perpendicular lines, and where these do not suffice lamps, spots and corners.

    Attributes:
        uv_px: (M, 2) in the level view.
        xy_base_m: (M, 2) on the ceiling, in base.
        cov_base_m2: (M, 2, 2).
        crossing_type: (M,) in 0..8, 3 * (kind of axis-0 line + 1) + (kind of axis-1 line + 1), and above for points;
            see ceilvo.crossing_types.
        psi_rad, psi_sigma_rad, tilt_rad, tilt_sigma_rad: as in Lines; psi_sigma_rad is NO_DIRECTION_RAD where
            there are no lines, and psi_rad then says nothing.
        common_cov_m2: (2, 2) the part of cov_base_m2 that all crossings of a frame share: an error of the tilt
            shifts them together.
        sample_gray: (S,) grey levels at fixed places of the picture, to tell whether it is an old one; (0,) = none.
        complete: whatever is seen of the ceiling is here; otherwise what is missing says nothing.
        several: they are at several heights, so what was taken to be at another height lies beside them.
        lines: that they are crossings of, and others; None where these may not lie where they seem to.
        fixtures_m: (F, 2) corners and spots in base beside the lines; None where they were not looked for.
    """

    uv_px: Array
    xy_base_m: Array
    cov_base_m2: Array
    crossing_type: Ints
    psi_rad: float
    psi_sigma_rad: float
    tilt_rad: Array
    tilt_sigma_rad: Array
    common_cov_m2: Array
    sample_gray: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    complete: bool = True
    several: bool = False
    lines: CeilingLines | None = None
    fixtures_m: Array | None = None

    def __len__(self) -> int:
        return len(self.crossing_type)

    def of(self, which: NDArray[np.bool_] | Ints) -> Crossings:
        """The features `which`, a mask (M,) or indices, of the same frame."""
        return replace(
            self,
            uv_px=self.uv_px[which],
            xy_base_m=self.xy_base_m[which],
            cov_base_m2=self.cov_base_m2[which],
            crossing_type=self.crossing_type[which],
        )

    @property
    def directed(self) -> bool:
        """Whether lines tell a direction."""
        return self.psi_sigma_rad < NO_DIRECTION_RAD


@dataclass(frozen=True, slots=True)
class Motion:
    """Planar motion between two frames, or none with its reason.

    Attributes:
        prev_from_curr: (3,) [m, m, rad]; maps static points seen now to where they were before: the robot's own way.
        cov: (3, 3); inliers, rms_m: correspondences used, and their residual of eq. 16; apart: see Registration.apart.
        failure: None, or why there is no motion (prev_from_curr is then a prediction).
        restarted: odometry goes on from this frame without having tied it to the last good one, so what was
            predicted in between is final. Otherwise the next good motion replaces the predictions before it.
        prior_cov: (3, 3) of prev_from_curr before anything was seen in this frame: what prediction alone knew.
        by_wheels, watched: as of WheelMotion, where the prediction is the wheels'; seen: vision measured it.
        alternatives: (A, 3) other displacements that this view fits too, whole tiles or quarter turns off, but those
            that are less likely than the rate of error that odometry may have.
        log_ratio: (A,) logarithm of how much likelier the view is at each than at prev_from_curr, but for predictions.
        doubt: probability that it is another, or that somebody moved the robot; 0 where nothing gave reason to look.
        doubt_left: part that this view leaves of what frames without a motion before it said of a hand.
    """

    prev_from_curr: Displacement
    cov: Array
    inliers: int
    rms_m: float
    failure: str | None = None
    restarted: bool = False
    prior_cov: Array = field(default_factory=lambda: np.zeros((3, 3)))
    by_wheels: bool = False
    watched: bool = False
    seen: bool = False
    alternatives: Array = field(default_factory=lambda: np.empty((0, 3)))
    log_ratio: Array = field(default_factory=lambda: np.empty(0))
    doubt: float = 0.0
    doubt_left: float = 1.0
    apart: float = np.inf

    @property
    def ok(self) -> bool:
        return self.failure is None


@dataclass(frozen=True, slots=True)
class WheelMotion:
    """Displacement that the base reports between two frames, prev_from_curr (3,) [m, m, rad] with cov (3, 3); watched:
    a gyro bears out that the robot stood on its wheels."""

    prev_from_curr: Displacement
    cov: Array
    watched: bool = False


NO_LANDMARK = -1
UNLABELLED = -2
"""Labels of Observations that are not the index of a landmark."""


@dataclass(frozen=True, slots=True)
class Observations:
    """What the filter is updated with.

    Attributes:
        xy_base_m: (K, 2).
        var_m2: (K, 2) diagonal of R along base x and y (eq. 27, squared).
        crossing_type: (K,) turned into the map's quadrant.
        label: (K,) landmark index, NO_LANDMARK for a feature that no landmark explains, or UNLABELLED where the filter
            shall find out itself.
        heading_rad, heading_var_rad2: heading in the map from the lines' common direction and R33 of eq. 27; an
            infinite variance means that there is none.
        common_var_m2: the part of var_m2 (mean of both axes) that all features of the frame share.
        visible_m: (V, 2) corners in base of a convex part of the ceiling, counter-clockwise, in which whatever is there
            would be seen; (0, 2) where that is not known, and then a landmark that is not seen says nothing.
        reach_m: no feature's landmark is further off, whatever the filter's own gate allows.
    """

    xy_base_m: Array
    var_m2: Array
    crossing_type: Ints
    label: Ints
    heading_rad: float = 0.0
    heading_var_rad2: float = float("inf")
    common_var_m2: float = 0.0
    visible_m: Array = field(default_factory=lambda: np.empty((0, 2)))
    reach_m: float = float("inf")

    def __len__(self) -> int:
        return len(self.label)

    def of(self, which: NDArray[np.bool_] | Ints) -> Observations:
        """The features `which`, a mask (K,) or indices, with the same heading."""
        return replace(
            self,
            xy_base_m=self.xy_base_m[which],
            var_m2=self.var_m2[which],
            crossing_type=self.crossing_type[which],
            label=self.label[which],
        )


@dataclass(frozen=True, slots=True)
class Landmarks:
    """The map as estimated.

    Attributes:
        ids, crossing_type: (L,).
        xy_map_m, cov_m2: (L, 2) and (L, 2, 2).
        sightings: (L,) how often each was seen.
        expected: (L,) how often each was in view and should have been seen; at least `sightings`, which it is where
            nobody counted (an empty array is given).
    """

    ids: Ints
    xy_map_m: Array
    cov_m2: Array
    crossing_type: Ints
    sightings: Ints
    expected: Ints = field(default_factory=lambda: np.empty(0, np.int64))

    def __post_init__(self) -> None:
        counted = np.maximum(self.expected, self.sightings) if len(self.expected) else self.sightings
        object.__setattr__(self, "expected", counted)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def visibility(self) -> Array:
        """(L,) chance that a view shows a landmark that is in it; the mean of a uniform prior after the counts."""
        return np.asarray((self.sightings + 1.0) / (self.expected + 2.0), np.float64)

    def of(self, which: NDArray[np.bool_] | Ints) -> Landmarks:
        """The landmarks `which`: a mask (L,), or their indices in the order wanted."""
        return Landmarks(
            self.ids[which],
            self.xy_map_m[which],
            self.cov_m2[which],
            self.crossing_type[which],
            self.sightings[which],
            self.expected[which],
        )


@dataclass(frozen=True, slots=True)
class FilterHealth:
    """How well the filter does.

    Attributes:
        particles: their number.
        ess: effective sample size of the weights that the last curve was fitted to, or that were resampled.
        unique_ancestors: distinct ancestors of the last resampling; None where particles have none, because they are
            drawn anew from a Gaussian.
        fit_residual: rms of eq. 22, nan when no curve was fitted.
        nis, nis_dof: mean normalised innovation squared per degree of freedom (1 is expected;
            slam.pose_filter.chi_square_bounds tells how far from it is chance), and those degrees of freedom.
        mode_weight: of the belief in the reported mode; below 1 other poses explain the view too; 1 while mapping.
    """

    particles: int
    ess: float
    unique_ancestors: int | None
    fit_residual: float
    nis: float
    nis_dof: int
    mode_weight: float = 1.0


@dataclass(frozen=True, slots=True)
class Estimate:
    """What the daemon says about one frame. pose is map_from_base, twist is in base, odom is odom_from_base.

    Attributes:
        floor: whose map the pose is on; "" where there is only one.
    """

    seq: int
    stamp_ns: int
    pose: Pose
    cov: Array
    odom: Pose
    twist: Twist
    state: State
    quality: float
    reason: str
    motion: Motion
    health: FilterHealth
    crossings: int
    landmarks: int
    latency_ms: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    floor: str = ""


def frozen(a: Array) -> Array:
    """The same array, read-only."""
    a.setflags(write=False)
    return a
