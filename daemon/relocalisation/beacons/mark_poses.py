"""Where a tag in the picture says that the robot is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration, in_base
from ceilvo.senses.beacons import Mark
from ceilvo.types import Array

CORNER_PX = 0.3
"""Standard deviation of a corner: 0.15 px measured on drawn pictures, and a lens adds as much."""
TILT_RAD = 0.006
"""Standard deviation of a robot's tilt on an ordinary floor, a third of a degree; chosen. It moves what is seen."""
SIZE_SHARE = 0.25
"""A tag that seems larger or smaller by more is not what the file names; chosen: at half the ceiling's height it would
seem twice as large."""
SHAPE_SHARE = 0.1
"""Of its side, that its corners may be off a square; chosen: one that hangs askew by 25 deg."""


@dataclass(frozen=True, slots=True)
class MarkPose:
    """map_from_base (3,) that a mark says, and what that is off by.

    Attributes:
        by_place: (3, 3) derivative by the pose of the mark in map; place_cov: (3, 3) of that.
        by_picture: (3, 3) derivative by the pose of the mark in base, as it is seen; picture_cov: (3, 3) of that.
        tilt_var: of each coordinate of what is seen, m^2, besides.
    """

    number: int
    pose: Array
    by_place: Array
    place_cov: Array
    by_picture: Array
    picture_cov: Array
    tilt_var: float

    @property
    def cov(self) -> Array:
        seen = self.picture_cov + self.tilt_var * np.diag([1.0, 1.0, 0.0])
        place = self.by_place @ self.place_cov @ self.by_place.T
        return np.asarray(place + self.by_picture @ seen @ self.by_picture.T)


def corners(size_m: float) -> Array:
    """(4, 2) of a tag in its own frame: x from its first corner to its second, z up like the map's."""
    return 0.5 * size_m * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def base_from_mark(calibration: Calibration, corners_px: Array, size_m: float) -> tuple[Array, float] | None:
    """Pose (3,) of a tag in base and its side in pixels; None where what is seen is no such tag.

    The side that it is known to have says how high it hangs: one below the ceiling seems larger.
    """
    at = in_base(calibration, corners_px)
    if not np.all(np.isfinite(at)):
        return None
    own = corners(size_m)
    middle = np.mean(at, axis=0)
    off = at - middle
    turn = complex(np.sum((own[:, 0] - 1j * own[:, 1]) * (off[:, 0] + 1j * off[:, 1])) / np.sum(own**2))
    scale = abs(turn)
    if abs(np.log(max(scale, 1e-9))) > np.log1p(SIZE_SHARE):
        return None
    theta = float(np.angle(turn))
    askew = off - scale * own @ se2.rotation(theta).T
    if np.max(np.abs(askew)) > SHAPE_SHARE * scale * size_m:
        return None
    foot = calibration.mount_xy_m
    side_px = float(np.mean(np.hypot(*np.diff(corners_px, axis=0, append=corners_px[:1]).T)))
    return np.array([*(foot + (middle - foot) / scale), theta]), side_px


def mark_pose(calibration: Calibration, mark: Mark, corners_px: Array) -> MarkPose | None:
    """What a mark in the picture says, None where it is not the one that is known."""
    found = base_from_mark(calibration, corners_px, mark.size_m)
    if found is None:
        return None
    seen, side_px = found
    map_from_mark = np.array([mark.x_m, mark.y_m, mark.theta_rad])
    pose = np.asarray(se2.compose(map_from_mark, se2.inverse(seen)))
    px_m = mark.size_m / side_px
    arm = seen[:2] - calibration.mount_xy_m
    # the height is taken from four corners, so what lies off the middle of the picture is off by its share
    depth = 0.5 * CORNER_PX / side_px * np.outer(arm, arm) * CORNER_PX / side_px
    picture_cov = np.diag([0.0, 0.0, (CORNER_PX / side_px) ** 2])
    picture_cov[:2, :2] = 0.25 * (CORNER_PX * px_m) ** 2 * np.eye(2) + depth
    place_cov = np.diag([mark.sigma_m**2, mark.sigma_m**2, mark.sigma_rad**2])
    by_place, by_picture = derivatives(pose, map_from_mark)
    return MarkPose(mark.number, pose, by_place, place_cov, by_picture, picture_cov, tilt_var(calibration))


def tilt_var(calibration: Calibration) -> float:
    """m^2 of each coordinate of what is seen at the ceiling, in base."""
    return (TILT_RAD * calibration.ceiling_height_m) ** 2


def derivatives(pose: Array, map_from_mark: Array) -> tuple[Array, Array]:
    """(3, 3) each: the base's pose by the mark's in map and by the mark's in base. A turn of either is one about it."""
    by_place = se2.lever(map_from_mark, pose)
    by_picture = -by_place
    by_picture[:2, :2] = -se2.rotation(float(pose[2]))
    return by_place, by_picture
