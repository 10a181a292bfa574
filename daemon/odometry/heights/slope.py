"""Puts crossings of a ceiling that slopes where they are over the floor.

Vision takes a slope for the robot's tilt: it sees the ceiling as from straight below its plane, at the calibrated
distance. Once it is known that the ceiling leans and not the robot, that is turned back, with the distance that there
is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration, to_ceiling
from ceilvo.crossing_types import LINE_CROSSINGS
from ceilvo.daemon.odometry.heights.leaning import (
    MOST_LEARNT,
    RASTER_M,
    direction_over_floor,
    lean_of,
    once,
    over_floor,
)
from ceilvo.daemon.odometry.heights.plane import HIGH_SIGMA, Plane, PlaneFit
from ceilvo.daemon.odometry.heights.seen_lines import SeenLines
from ceilvo.daemon.odometry.heights.similarity import of_views
from ceilvo.daemon.odometry.heights.tiles import seen_high
from ceilvo.daemon.odometry.lines.direction import direction_change
from ceilvo.types import Array, Crossings, Motion

_AT_FIRST, _STEADY_RAD, _LEANS = 5, np.radians(0.1), math.tan(math.radians(2.5))
"""Frames, in which a robot that stands leans alike, and by so much at least that it is the ceiling that does; chosen:
no robot does by that much, and one that rocks does not stay like that."""
_LEAST, _SIGMAS = math.tan(math.radians(0.6)), 6.0
"""A ceiling slopes that rises by so much and so surely; chosen: an error of the lens makes 0.3 deg."""
_LOOK_M, _LOOK_RAD = 0.1, math.radians(3.0)
"""Way and turn after which what is known is put together; chosen."""
_OTHER_HIGH = 0.01
"""By so much tiles must say that a ceiling that leans is higher or lower than calibrated; chosen: where it is as high,
taking its lean for the robot's does no harm until that turns."""
_REACH_M = 15.0
"""From where the height was calibrated, at most; chosen, a hall: tiles that are further off by a rise are others."""
_KEY_M, _KEY_RAD = 0.3, math.radians(20.0)
"""A view serves for so much way and turn; chosen: half of the crossings stay in view."""
_PLAUSIBLE = 3.0 * HIGH_SIGMA
"""Of the height over the calibrated one: a plane that is further off is none; 99.7 %."""
_SCALE_SIGMA = 0.0005
"""Least, of the ratio of two views' sizes; chosen: 0.5 mm on a metre, as errors of lens and lines that move past."""
_TILE_SIGMA = 0.002  # of a height by tiles; chosen: errors of the lens are the same in all frames
_HIGH_KNOWN = 0.004
"""Standard deviation of the height over the calibrated one with which a way is good to half a per cent; chosen."""
_BLIND_M = 0.3  # chosen: off the start by less, a height that is wrong by a twentieth makes 15 mm
_OTHER_RAD, _OTHER_SIGMAS, _OTHER_FRAMES = math.radians(1.2), 3.0, 8
"""By how much, also in units of its scatter, and in how many frames in a row a view leans otherwise than the plane,
when that has ended; chosen: a robot that rocks leans by twice the scatter at most."""
_AFTER_SIGMA = 0.02
"""Of the height over the calibrated one where another plane begins; chosen."""
_LEVEL = 1e-12
"""Square of a rise that is none: not divided by 0."""
_MISPLACED_M = 0.005
"""What was learnt so far beside where it is, is to be learnt anew; chosen: sightings agree to 2 mm."""
_BENT = 0.0015
"""rad, by which the joint fit takes a right angle for another one (over_floor); chosen: so do 3 deg obliquely to the
lines, and 5 deg from 11 deg off them on."""
_AWAY_M, _AWAY_RAD = 0.05, math.radians(0.5)
"""By which the way may be off the pose on the map that the plane is of: 5 cm are 5 mm of height under 6 deg; chosen."""
_FIRST_FRAMES = 20
"""In which a tilt may not have been told yet, so that the places of crossings are remembered in any case; chosen."""
HEIGHT_UNKNOWN = "the ceiling slopes: how high it is where the robot began is not known"
OBLIQUE = "the ceiling slopes obliquely to its lines"
ANOTHER = "the ceiling slopes otherwise than before"


@dataclass(slots=True)
class SlopeState:
    """All that the stage remembers.

    Attributes:
        pose: (3,) of base along fixed axes, those of base at the start.
        fit: what is known of the plane.
        used: the plane that crossings are placed by; None while the ceiling is taken to be level.
        first_lean: (2,) of the first frame, None before it; steady: whether all frames since lean alike.
        looked: (3,) pose when what is known was put together last.
        key, key_pose: a view that later ones are compared with, as vision gave it, and pose (3,) there.
        raw: the last frame's crossings, as vision gave them; None where it gave no motion.
        other_frames: in a row that leant otherwise than the plane.
        by_tiles: the height is known by them.
        ended: a plane ended before.
        bent: lines that cross at right angles do not seem to, more than the joint fit bears.
        on_map: the fixed axes are the map's, and pose is that on it, for the plane is known of an earlier run.
        here: (3,) on the map in the last frame, None where that was in doubt.
        learnt: (N, 2) along the fixed axes, where crossings were taken to be in the first frames and in those that
            leant, before a plane was known; some more than once.
    """

    pose: Array = field(default_factory=lambda: np.zeros(3))
    fit: PlaneFit = field(default_factory=PlaneFit)
    used: Plane | None = None
    first_lean: Array | None = None
    steady: bool = True
    looked: Array = field(default_factory=lambda: np.zeros(3))
    key: Crossings | None = None
    key_pose: Array = field(default_factory=lambda: np.zeros(3))
    raw: Crossings | None = None
    other_frames: int = 0
    by_tiles: bool = False
    ended: bool = False
    bent: bool = False
    on_map: bool = False
    here: Array | None = None
    learnt: Array = field(default_factory=lambda: np.zeros((0, 2)))


class Slope:
    """Before heights, which are over the plane. While no slope is known nothing is changed.

    Attributes:
        misplaced: (N, 2) in base, where crossings of the last frame were taken to be until it told otherwise.
        moved: the last frame showed that the plane is another one than it was placed by.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._mount, self._level_from_ceiling = calibration.mount_xy_m, calibration.level_from_ceiling
        self._high_m, self._tile_m = calibration.ceiling_height_m, calibration.tile_m
        self.state = SlopeState()
        self.moved, self.misplaced = False, np.zeros((0, 2))
        self._seen: Crossings | None = None

    @property
    def suspicion(self) -> str:
        """What is wrong with the way, for people; "" for nothing."""
        s = self.state
        if s.used is None or float(np.hypot(*s.pose[:2])) < _BLIND_M:
            return ""
        if s.ended and not s.by_tiles:
            return ANOTHER
        if s.bent:
            return OBLIQUE
        return "" if s.by_tiles else HEIGHT_UNKNOWN

    def know(self, slope: tuple[float, ...], pose: Array) -> None:
        """Begin at a pose (3,) on a map, with its slope as an earlier run found it, see CeilingShape."""
        self.state = SlopeState()
        if slope:
            fit = PlaneFit.known(np.array(slope[:2]), slope[2])
            self.state = SlopeState(pose.copy(), fit, fit.solve(), looked=pose.copy(), by_tiles=True, on_map=True)

    def on_map(self, pose: Array) -> tuple[float, ...]:
        """The slope, see CeilingShape, where the robot is at a pose (3,) on the map; () where none is known."""
        s = self.state
        if s.used is None or not s.by_tiles:
            return ()
        map_from_axes = se2.compose(pose, se2.inverse(s.pose))
        rise = se2.rotation(float(map_from_axes[2])) @ s.used.rise
        high = s.used.high - float(rise @ map_from_axes[:2]) / self._high_m
        return (float(rise[0]), float(rise[1]), high)

    def _follow(self) -> None:
        """Go on from where the map has the robot, where the plane is of that map."""
        s = self.state
        off = np.zeros(3) if s.here is None else se2.between(s.pose, s.here)
        if s.here is not None and s.on_map and (np.hypot(*off[:2]) > _AWAY_M or abs(off[2]) > _AWAY_RAD):
            s.pose, s.looked, s.key, s.raw = s.here.copy(), s.here.copy(), None, None

    def placed(self, crossings: Crossings | None, expected: Array | None) -> Crossings | None:
        """Crossings where they are; expected: (3,) motion since the last frame."""
        self._follow()
        s = self.state
        usable = crossings is not None and crossings.directed
        self._seen = crossings if usable else None
        if crossings is None or not usable or s.used is None:
            return crossings
        pose = se2.compose(s.pose, np.zeros(3) if expected is None else expected)
        if s.raw is not None:  # a heading that lags behind turns the rise with it
            last_rad = s.raw.psi_rad + s.pose[2]
            pose[2] = direction_change(last_rad, crossings.psi_rad, float(pose[2]))
        return self._on(s.used, crossings, pose)

    def reference(self) -> Crossings | None:
        """The last frame's crossings, where they are as is known now."""
        s = self.state
        return None if s.raw is None or s.used is None or not self.moved else self._on(s.used, s.raw, s.pose)

    def learn(self, motion: Motion, several: bool = False) -> None:
        """What the motion says about the plane; several: heights are known, which tell views' sizes from then on."""
        s, self.moved, self.misplaced = self.state, False, np.zeros((0, 2))
        s.pose = se2.compose(s.pose, motion.prev_from_curr)
        if motion.restarted:  # the plane stays, unless it turns out to lean otherwise: somebody turned the robot
            s.key = None
        s.raw = raw = self._seen if motion.ok or motion.restarted else None
        if raw is None:
            return
        lean, turned = lean_of(raw.tilt_rad), float(s.pose[2])
        expected = None if s.used is None else self._expected_lean(s.used, turned)
        s.fit.take_lean(lean, turned)
        if s.first_lean is None:
            s.first_lean = lean
        if s.used is None and (s.fit.frames < _FIRST_FRAMES or float(np.hypot(*lean)) > _LEAST):
            new = RASTER_M * np.rint(se2.transform(s.pose, raw.xy_base_m) / RASTER_M)
            s.learnt = np.vstack([s.learnt, new])
            if len(s.learnt) > 2 * MOST_LEARNT:
                s.learnt = once(s.learnt)
        s.steady &= bool(np.max(np.abs(lean - s.first_lean)) < _STEADY_RAD)
        if expected is not None and self._is_other(lean - expected):
            s = self._begin_anew(s.used)
        way = se2.between(s.looked, s.pose)
        if several and s.used is None:
            s.key = None
        elif s.key is None or s.fit.frames == _AT_FIRST or np.hypot(*way[:2]) > _LOOK_M or abs(way[2]) > _LOOK_RAD:
            self._put_together(raw)

    # -- what is known of the plane

    def _put_together(self, crossings: Crossings) -> None:
        s = self.state
        s.looked = s.pose
        plane = self._compared(crossings).solve()
        rises = float(np.hypot(*plane.rise)) > _LEAST and s.fit.frames >= _AT_FIRST
        if s.used is None and not rises:
            return
        if self._tile_m is not None and self._by_tiles(crossings, plane, self._tile_m):
            plane = self._compared(crossings).solve()
            s.by_tiles = plane.high_sigma < _HIGH_KNOWN
        if s.used is None and not self._is_sure(plane):
            return
        self.misplaced = self._misplaced(crossings, plane)
        across, along = se2.rotation(-float(s.pose[2]) - crossings.psi_rad) @ plane.rise
        s.bent = abs(float(across * along)) > _BENT
        s.used, self.moved, s.learnt = plane, True, np.zeros((0, 2))

    def _is_sure(self, plane: Plane) -> bool:
        """Whether it is the ceiling that leans and not the robot."""
        s = self.state
        stands = s.fit.frames == _AT_FIRST and s.steady and float(np.hypot(*plane.rise)) > _LEANS
        otherwise = s.by_tiles and abs(plane.high - 1.0) > _OTHER_HIGH
        plausible = abs(plane.high - 1.0) < _PLAUSIBLE
        return plausible and (stands or otherwise or plane.rises_for_sure(_LEAST, _SIGMAS))

    def _misplaced(self, crossings: Crossings, plane: Plane) -> Array:
        """(N, 2) in base, where crossings were taken to be that are elsewhere on this plane."""
        s = self.state
        if s.used is None:
            return np.vstack([crossings.xy_base_m, se2.transform(se2.inverse(s.pose), once(s.learnt))])
        before, after = (self._on(p, crossings, s.pose).xy_base_m for p in (s.used, plane))
        return np.asarray(before[np.hypot(*(after - before).T) > _MISPLACED_M])

    def _compared(self, crossings: Crossings) -> PlaneFit:
        """What is known, with the size of this view against that of an earlier one."""
        s = self.state
        fit, way = s.fit, se2.between(s.key_pose, s.pose)
        found = None if s.key is None else of_views(s.key, crossings, way, self._mount, self._high_m)
        if found is not None and s.key is not None:
            before, now = self._camera(s.key_pose), self._camera(s.pose)
            fit = s.fit.with_scale(found.scale, max(_SCALE_SIGMA, found.sigma), before, now, self._high_m)
        if found is None or np.hypot(*way[:2]) > _KEY_M or abs(way[2]) > _KEY_RAD:
            s.fit, s.key, s.key_pose = fit, crossings, s.pose
        return fit

    def _by_tiles(self, crossings: Crossings, plane: Plane, tile_m: float) -> bool:
        """Take in the height by tiles, if they tell it."""
        s = self.state
        crossed = crossings.of(crossings.crossing_type < LINE_CROSSINGS)
        lines = SeenLines.of(crossed, self._mount, -crossings.psi_rad)
        rise = se2.rotation(-float(s.pose[2])) @ plane.rise
        steep = 1.0 + float(rise @ rise)
        count = np.bincount(lines.of_crossing.ravel(), minlength=len(lines)).astype(np.float64)
        found = False
        for axis in (0, 1):
            of = (lines.axis == axis) & (lines.kind == 0)
            seen = seen_high(lines.apparent_m[of], count[of], tile_m, self._above(plane, s.pose) / self._high_m)
            if seen is not None and abs(seen[0] - 1.0) * self._high_m < math.sqrt(steep - 1.0) * _REACH_M:
                along = float(lines.normals[axis] @ rise) ** 2 / max(steep - 1.0, _LEVEL)
                # tiles along the slope seem smaller by its root or by all of it: whether it or the floor was laid out
                factor = 1.0 + along * (steep**0.75 - 1.0)
                sigma = math.hypot(_TILE_SIGMA, along * (steep**0.25 - 1.0))
                s.fit.take_high(seen[0] * factor, sigma, self._camera(s.pose), self._high_m)
                found = True
        return found

    def _is_other(self, off: Array) -> bool:
        s = self.state
        other = float(np.hypot(*off)) > max(_OTHER_RAD, _OTHER_SIGMAS * math.sqrt(s.fit.scatter))
        s.other_frames = s.other_frames + 1 if other else 0
        return s.other_frames >= _OTHER_FRAMES

    def _begin_anew(self, plane: Plane | None) -> SlopeState:
        """Another plane begins where this one has brought the robot to."""
        high = 1.0 if plane is None else self._above(plane, self.state.pose) / self._high_m
        fit = PlaneFit.beginning(high, _AFTER_SIGMA)
        self.state = SlopeState(fit=fit, used=fit.solve(), raw=self.state.raw, ended=True)
        return self.state

    # -- where things are

    def _camera(self, pose: Array) -> Array:
        """(2,) at a pose (3,), along the fixed axes."""
        return np.asarray(se2.rotation(float(pose[2])) @ self._mount + pose[:2])

    def _above(self, plane: Plane, pose: Array) -> float:
        """Height of the plane above the camera at a pose (3,), m."""
        return self._high_m * plane.high + float(plane.rise @ self._camera(pose))

    @staticmethod
    def _expected_lean(plane: Plane, turned_rad: float) -> Array:
        """(2,) that a view should show."""
        return np.asarray(se2.rotation(-turned_rad) @ plane.rise + plane.lean)

    def _on(self, plane: Plane, crossings: Crossings, pose: Array) -> Crossings:
        """Crossings that were seen at a pose (3,), on the plane."""
        rise = se2.rotation(-float(pose[2])) @ plane.rise
        flat, off = over_floor(rise)
        scale = self._above(plane, pose) / self._high_m
        xy = self._mount + scale * ((crossings.xy_base_m - self._mount) @ flat + self._high_m * off)
        return replace(
            crossings,
            uv_px=to_ceiling(self._level_from_ceiling, xy),
            xy_base_m=xy,
            cov_base_m2=crossings.cov_base_m2 * scale**2,
            psi_rad=direction_over_floor(flat, crossings.psi_rad),
            tilt_rad=crossings.tilt_rad - np.array([-rise[1], rise[0]]),
            common_cov_m2=crossings.common_cov_m2 * scale**2,
            complete=False,  # who asks what should be in view asks of a level ceiling at the calibrated height
        )
