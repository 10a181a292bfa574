"""Lights in a picture held against the lamps that a pose expects."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration, in_base, visible_polygon
from ceilvo.daemon.relocalisation.beacons.mark_poses import tilt_var
from ceilvo.daemon.relocalisation.beacons.trust import WRONG_M
from ceilvo.senses.beacons import Lamp, LampSeen
from ceilvo.types import Array

GATE = 13.8
"""Squared distance of two degrees of freedom that one lamp in a thousand which is where it should be exceeds."""
MOVED_M = 0.5
"""A light so near to where a lamp should be, which is not there, is that lamp; chosen: neighbours are further off."""
WIDEST_M = 0.4
"""Standard deviation of where a lamp is expected, beyond which any light might be it; chosen."""
SURE_M = 0.05
"""The same, up to which a lamp that is not where it should be is the lamp's fault; chosen."""
BLOB_M = 0.005
"""Standard deviation of the middle of a light; chosen: it is not the same on all of a lamp."""
_MARGIN_PX = 40.0
"""From the side of the picture where a lamp must be seen whole; chosen: half of a lamp."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A lamp and the light that it is.

    Attributes:
        lamp: row among the known.
        off: (2,) light less where the pose has it, m in base; by_pose: (2, 3) derivative of the latter.
        own_var: variance of each coordinate of the lamp's own place.
    """

    lamp: int
    off: Array
    by_pose: Array
    own_var: float


@dataclass(frozen=True, slots=True)
class Held:
    """pairs; moved: rows of lamps whose light is elsewhere, and how far, m; missing: rows that should be seen."""

    pairs: tuple[Pair, ...]
    moved: tuple[tuple[int, float], ...]
    missing: tuple[int, ...]


class LampView:
    """Of one camera.

    Attributes:
        seen_var: of each coordinate of a light, m^2: what the floor's tilt makes of all in a picture, and the rest.
    """

    def __init__(self, calibration: Calibration, max_view_deg: float) -> None:
        self._calibration, self._max_view_deg = calibration, max_view_deg
        self._polygon: Array | None = None
        self._reach_m = calibration.ceiling_height_m * float(np.tan(np.radians(max_view_deg))) + MOVED_M
        self.seen_var = tilt_var(calibration), BLOB_M**2

    @property
    def foot_m(self) -> Array:
        """(2,) of the camera in base."""
        return np.asarray(self._calibration.mount_xy_m)

    @property
    def seen_sigma_m(self) -> float:
        """Of a light, in base."""
        return float(np.sqrt(sum(self.seen_var)))

    def nearer(self, lamp: Lamp) -> float:
        """By which share of its distance at the ceiling a lamp that hangs below it is off the camera's foot."""
        return 1.0 - lamp.below_m / self._calibration.ceiling_height_m

    def lights(self, seen: tuple[LampSeen, ...]) -> Array:
        """(N, 2) from the camera's foot, at the ceiling, in base."""
        if not seen:
            return np.zeros((0, 2))
        at = in_base(self._calibration, np.array([one.at_px for one in seen])) - self.foot_m
        return np.asarray(at[np.all(np.isfinite(at), axis=1)])

    def hold(self, lamps: tuple[Lamp, ...], lights: Array, pose: Array, cov: Array) -> Held:
        """Lights (N, 2) against the lamps that a pose (3,) with covariance (3, 3) expects.

        A light is a lamp where both are each other's only choice.
        """
        turn = se2.rotation(float(pose[2])).T
        places = np.array([[lamp.x_m, lamp.y_m] for lamp in lamps]).reshape(-1, 2)
        expected = (places - pose[:2]) @ turn.T
        pairs, moved, missing = [], [], []
        fits = np.zeros((len(lamps), len(lights)), bool)
        found: dict[tuple[int, int], Pair] = {}
        off_m = np.full(fits.shape, np.inf)
        wide = np.full(len(lamps), np.inf)
        near = np.hypot(*(expected - self.foot_m).T) < self._reach_m
        for i in np.flatnonzero(near).tolist():
            lamp = lamps[i]
            by = np.column_stack([-turn, [expected[i, 1], -expected[i, 0]]])
            own = (self.seen_sigma_m**2 + lamp.sigma_m**2) * np.eye(2)
            total = by @ cov @ by.T + own
            wide[i] = np.sqrt(se2.greatest_variance(total))
            if wide[i] > WIDEST_M or self._apart(places, i) < 2.0 * np.sqrt(GATE) * wide[i]:
                wide[i] = np.inf
                continue
            for j, light in enumerate(lights):
                off = self.foot_m + self.nearer(lamp) * light - expected[i]
                off_m[i, j] = np.hypot(off[0], off[1])
                fits[i, j] = off_m[i, j] < WRONG_M or float(off @ np.linalg.solve(total, off)) < GATE
                found[i, j] = Pair(i, off, by, lamp.sigma_m**2)
        for i in np.flatnonzero(np.isfinite(wide)).tolist():
            mine = np.flatnonzero(fits[i])
            if len(mine) == 1 and np.count_nonzero(fits[:, mine[0]]) == 1:
                pairs.append(found[i, int(mine[0])])
            if len(mine) or wide[i] > SURE_M + lamps[i].sigma_m:
                continue
            free = np.where(np.any(fits, axis=0), np.inf, off_m[i])
            if len(free) and np.min(free) < MOVED_M:
                moved.append((i, float(np.min(free))))
            elif self._in_view(self.foot_m + (expected[i] - self.foot_m) / self.nearer(lamps[i])):
                missing.append(i)
        return Held(tuple(pairs), tuple(moved), tuple(missing))

    @staticmethod
    def _apart(places: Array, i: int) -> float:
        """m from a lamp to the nearest other one."""
        away = np.hypot(*(places - places[i]).T)
        away[i] = np.inf
        return float(np.min(away))

    def _in_view(self, at: Array) -> bool:
        """Whether the camera must show a light at a place (2,) of the ceiling in base."""
        if self._polygon is None:
            self._polygon = visible_polygon(self._calibration, _MARGIN_PX, self._max_view_deg)
        if not len(self._polygon):
            return False
        side, to = np.roll(self._polygon, -1, axis=0) - self._polygon, at - self._polygon
        return bool(np.all(side[:, 0] * to[:, 1] - side[:, 1] * to[:, 0] > 0.0))
