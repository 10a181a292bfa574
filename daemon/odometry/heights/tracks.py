"""Lines followed over the frames: how fast each moves past the camera tells how high it is.

A line at the calibrated height moves past as fast as the camera does, a lower one faster. What is measured is that
ratio, calibrated over true height.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.daemon.odometry import kernel
from ceilvo.daemon.odometry.heights.seen_lines import SeenLines
from ceilvo.daemon.odometry.kernel.arguments import Limits, RatioNoise
from ceilvo.types import Array, Ints

Bools = NDArray[np.bool_]

UNKNOWN = -1
"""In place of a level."""
_GATE_M = 0.02
"""How far from where it was expected a line may be; chosen: a new one may be a third lower than it is taken for."""
_MOST_FOUND = 0.8
"""Of the lines, where fewer are where they were expected, they are looked for further off; chosen."""
_FURTHER_M, _AS_MANY = 0.28, 0.8
"""How far at most, less than half a tile of .6 m; and a shift that so many times as many lines share as any other is as
likely; chosen."""
_STEP_M = 0.004
"""A line is measured again once the camera has moved so far towards it; chosen: before, the same error is seen."""
_SIGMA_M, _SIGMA_RATIO = 0.0004, 0.002
"""Of a line's distance over a few centimetres, where lines of one plane were found to agree to 0.1 mm; and of its ratio
however far it is followed, for what lens and tilt leave; chosen."""
_INDEPENDENT = 8.0
"""Measurements of a line that err on their own, at most; chosen, for the same reason."""
_USUAL_PX_M = 0.0054
"""Of the ceiling in a pixel of the level view, where these were measured: 2.2 m above a focal length of 410 px. Where a
pixel is more, errors are so many times larger: lines scatter by 0.08 mm there, by 0.6 at 21 mm in a pixel."""
_PATIENCE = 4
"""Frames in a row in which a line may be missing; chosen."""
_OUTLIER_SIGMAS, _OUTLIER_M = 4.0, 0.003
"""A measurement further off is of another line that lies over this one; chosen."""
FEWEST = 4
"""Measurements of a line before one of them, or the line, is judged."""
_STRANGE = 3
"""Measurements in a row that are not of the line that was followed: it is another; chosen."""
_STEADY = 1.5
"""A line moves evenly whose distance scatters by no more than so many times what is usual; chosen."""
_SLOPE_LINES, _SLOPE_SIGMA, _SLOPE_RISE, _SLOPE_FITS = 6, 0.02, 0.05, 0.35
"""Lines that show a slope, how well each must be known, by how much their ratios differ along it, and what a straight
line may leave of their spread; chosen: 5 deg make 0.13 in a view, and a step of any height leaves more than half."""


@dataclass(frozen=True, slots=True)
class Sharpness:
    """How well a camera sees where lines are.

    Attributes:
        coarse: how many times larger its errors are than those that the constants are of; at least 1.
    """

    coarse: float = 1.0

    @staticmethod
    def of(calibration: Calibration) -> Sharpness:
        return Sharpness(max(calibration.metres_per_px / _USUAL_PX_M, 1.0))

    @property
    def noise(self) -> RatioNoise:
        return RatioNoise(self.coarse * _STEP_M, self.coarse * _SIGMA_M, _SIGMA_RATIO, _INDEPENDENT)

    @property
    def limits(self) -> Limits:
        return Limits(_OUTLIER_SIGMAS, self.coarse * _OUTLIER_M, FEWEST, _STRANGE)

    @property
    def steady_m(self) -> float:
        return self.coarse * _STEADY * _SIGMA_M


@dataclass(slots=True)
class Tracks:
    """(T,) lines.

    Attributes:
        axis, kind: as in SeenLines.
        apparent_m: where each was seen last, and camera_m: where the camera was then along its normal.
        measured_m: the same at the last measurement.
        sums: (T, 6) of the measurements: 1, camera, apparent, camera squared, camera times apparent, apparent squared,
            in m.
        level: number of the level that each is taken to be on, or UNKNOWN.
        own: whether its own measurements say so.
        missing: frames since each was seen.
        strange: measurements in a row that were not of the same line.
        name: a number of its own, rising.
    """

    axis: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    kind: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    apparent_m: Array = field(default_factory=lambda: np.zeros(0))
    camera_m: Array = field(default_factory=lambda: np.zeros(0))
    measured_m: Array = field(default_factory=lambda: np.zeros(0))
    sums: Array = field(default_factory=lambda: np.zeros((0, 6)))
    level: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    own: Bools = field(default_factory=lambda: np.zeros(0, bool))
    missing: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    strange: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    name: Ints = field(default_factory=lambda: np.zeros(0, np.int64))

    def __len__(self) -> int:
        return len(self.axis)

    def of(self, which: Bools | Ints) -> Tracks:
        return Tracks(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def followed(self, seen: SeenLines, camera_m: Array, ratio: Array) -> Ints:
        """(L,) the track of each line seen, or -1.

        Where most of an axis are not where they were expected, all may have moved on alike: after a gap, or when the
        robot started or stopped at once.

        Args:
            camera_m: (2,) where it should be now.
            ratio: (T,) how fast each track moves past, over the camera.
        """
        expected = self.apparent_m - (camera_m[self.axis] - self.camera_m) * ratio
        found = self._near(seen, expected)
        for axis in (0, 1):
            there, of = seen.axis == axis, self.axis == axis
            had = np.count_nonzero(found[there] >= 0)
            if had >= _MOST_FOUND * min(np.count_nonzero(there), np.count_nonzero(of)):
                continue
            by_m = self._further_m(seen, expected, ratio, axis)
            further = self._near(seen, expected - by_m * of * ratio)
            if np.count_nonzero(further[there] >= 0) > had:
                found = np.where(there, further, found)
        return found

    def _near(self, seen: SeenLines, expected_m: Array) -> Ints:
        found: Ints = kernel.lines_followed(
            seen.axis, seen.kind, seen.apparent_m, self.axis, self.kind, expected_m, _GATE_M
        )
        return found

    def _further_m(self, seen: SeenLines, expected_m: Array, ratio: Array, axis: int) -> float:
        """How much further the camera is along an axis by most of its lines; the least of those that are as likely."""
        alike = (seen.axis[:, None] == axis) & (self.axis == axis) & (seen.kind[:, None] == self.kind)
        further = (expected_m - seen.apparent_m[:, None]) / ratio
        at = np.sort(further[alike & (np.abs(further) < _FURTHER_M)])
        if not len(at):
            return 0.0
        first, last = (np.searchsorted(at, at + half) for half in (-0.5 * _GATE_M, 0.5 * _GATE_M))
        likely = np.flatnonzero(last - first >= _AS_MANY * np.max(last - first))
        best = likely[np.argmin(np.abs(at[likely]))]
        return float(np.mean(at[first[best] : last[best]]))

    def seen_again(self, seen: SeenLines, track: Ints, camera_m: Array, next_name: int) -> tuple[Tracks, Ints]:
        """With the lines of a frame, the camera at (2,), new ones included; and the track of each line."""
        new = np.flatnonzero(track < 0)
        t = self._grown(seen, new, next_name)
        track = track.copy()
        track[new] = len(self) + np.arange(len(new))
        t.missing += 1
        t.missing[track] = 0
        t.apparent_m[track], t.camera_m[track] = seen.apparent_m, camera_m[seen.axis]
        return t, track

    def measure(self, row: Ints, sharp: Sharpness) -> None:
        """Take in where the tracks `row` were seen last, as far as that is news."""
        others = kernel.lines_measured(
            row, self.camera_m, self.apparent_m, self.measured_m, self.sums, self.strange, sharp.noise, sharp.limits
        )
        if len(others):
            self._begin_anew(others)

    def _begin_anew(self, row: Ints) -> None:
        """Another line is followed in their place."""
        self.sums[row], self.measured_m[row], self.strange[row] = 0.0, np.nan, 0
        self.level[row], self.own[row] = UNKNOWN, False

    def forget_measurements(self) -> None:
        """What was measured so far was against a camera that moved otherwise."""
        self.sums[:], self.measured_m[:] = 0.0, np.nan

    def lost(self) -> Bools:
        """(T,) those that were missing for too long."""
        return np.asarray(self.missing > _PATIENCE)

    def _grown(self, seen: SeenLines, new: Ints, next_name: int) -> Tracks:
        if not len(new):
            return self
        n, nowhere = len(new), np.full(len(new), np.nan)
        more = Tracks(
            seen.axis[new],
            seen.kind[new],
            nowhere,
            nowhere,
            nowhere,
            np.zeros((n, 6)),
            np.full(n, UNKNOWN),
            np.zeros(n, bool),
            np.zeros(n, np.int64),
            np.zeros(n, np.int64),
            next_name + np.arange(n),
        )
        return replace(
            self, **{f.name: np.concatenate([getattr(self, f.name), getattr(more, f.name)]) for f in fields(self)}
        )

    def ratios(self, sharp: Sharpness) -> tuple[Array, Array]:
        """(T,) how fast each moves past, over the camera; (T,) its standard deviation, infinite where not measured."""
        return self._fitted(sharp)[:2]

    def steady(self, sharp: Sharpness) -> Bools:
        """(T,) lines that were measured often and moved evenly: others are two that lie over each other."""
        bent = self._fitted(sharp)[2]
        return np.asarray((self.sums[:, 0] >= FEWEST) & (bent <= sharp.steady_m**2))

    def slopes(self, ratio: Array, sigma: Array, sharp: Sharpness) -> bool:
        """Whether ratios (T,) follow a slope better than levels."""
        for axis in (0, 1):
            of = (self.axis == axis) & (sigma < _SLOPE_SIGMA) & self.steady(sharp)
            if np.count_nonzero(of) < _SLOPE_LINES:
                continue
            at, r = self.apparent_m[of], ratio[of]
            steep, middle = np.polyfit(at, r, 1)
            off = float(np.sqrt(np.mean((r - steep * at - middle) ** 2)))
            if abs(steep) * np.ptp(at) > _SLOPE_RISE and off < _SLOPE_FITS * float(np.std(r)):
                return True
        return False

    def ways_m(self) -> Array:
        """(T,) how far the camera moved towards each line while that was measured, were it evenly."""
        n, s, _, ss = self.sums[:, :4].T
        n = np.maximum(n, 1.0)
        return np.asarray(np.sqrt(12.0 * np.maximum(ss / n - (s / n) ** 2, 0.0)))

    def _fitted(self, sharp: Sharpness) -> tuple[Array, Array, Array]:
        """As kernel.line_ratios()."""
        ratio, sigma, bent = kernel.line_ratios(self.sums, sharp.noise)
        return ratio, sigma, bent

    def rescaled(self, factor: float) -> None:
        """What the camera moved until now was so many times too long."""
        for axis in (0, 1):
            of = self.axis == axis
            now = self.camera_m[of]
            n, s, a, ss, sa, _ = self.sums[of].T
            shift = now - now / factor  # s' = s / factor + shift keeps where it is now
            self.sums[of, 1] = s / factor + n * shift
            self.sums[of, 3] = ss / factor**2 + 2.0 * shift * s / factor + n * shift**2
            self.sums[of, 4] = sa / factor + shift * a
            self.measured_m[of] = self.measured_m[of] / factor + shift
