"""Puts crossings of lines at other heights than the calibrated one where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceilvo.calibration import Calibration, to_ceiling
from ceilvo.crossing_types import LINE_CROSSINGS
from ceilvo.daemon.odometry.heights.by_map import AskMap, MapHere, levels_by_map, no_map
from ceilvo.daemon.odometry.heights.heights_state import HeightsState
from ceilvo.daemon.odometry.heights.levels import SAME, SIGMAS, Levels, believed
from ceilvo.daemon.odometry.heights.seen_lines import SeenLines
from ceilvo.daemon.odometry.heights.tracks import UNKNOWN, Bools, Sharpness, Tracks
from ceilvo.daemon.odometry.points.constellation import has_points
from ceilvo.se2 import rotation
from ceilvo.types import Array, Crossings, Ints, Motion

_QUARTER_RAD = 0.5 * np.pi
_TELLING = 0.02
"""Standard deviation of a line's own ratio from which on it says itself which level it is on; chosen."""
_VAGUE = 0.05
"""The same where no other level fits."""
_MAJORITY = 0.6
"""Of the lines that cross another, so many are on one level if that is; chosen."""
_MINORITY = 0.25
"""It stays on that level while no fewer are, ..."""
_OUTVOTED = 3
"""... or while less than so many are on others: what ends at the edge of a step crosses it; chosen."""
_FEWEST = 6
"""Crossings of known height that a motion needs; with fewer those of unknown height help; chosen."""
_ASKS = 0.5
"""Of the crossings in view, where the heights of fewer are known, the map is asked; chosen."""
_MOST_SAY = 4
"""Crossings of a line that count in the choice of the calibrated level: a bar across many joints is one bar; chosen."""
_HIGHEST = 0.6
"""The calibrated level is the highest of those that have so much of the largest one's weight: things hang from a
ceiling; chosen."""
_APART_M = 0.05
"""Lines nearer to each other are of one thing, and may be mistaken together; chosen: as wide as a vent's slats."""
_LONG, _SURE = 10, 0.006
"""Measurements of a line that founds a level on its own, and its standard deviation; chosen."""
_COMPLETE = 0.9
"""Where fewer of the crossings are of known height, what is missing in the view says nothing; chosen."""
_STRANGE = 0.05
"""A line is not of the calibrated plane whose ratio differs by so much: 10 cm at 2.2 m; chosen."""
SLOPES = "the ceiling slopes"
_PARALLAX_M = 0.008
"""A line that founds a level has moved past by so much more or less than one of any other level: single lines, and the
way of a camera that sees five crossings, were found to be off by 4.5 mm while a robot turned on the spot."""
_FIRST_SIGMA = 0.02
"""Standard deviation of the first other height's ratio, for the way was measured by both heights until then; measured:
a truss was found 2.3 % too low, and none of its lines fitted that level afterwards."""
_CROSSED = 2
"""Crossings of a line that founds a level: what is seen once is a stray edge."""
_ANCHORED = 0.004**-2
"""So well the calibrated level's own ratio must be known; chosen."""
_ALIKE = 0.01
"""What the calibrated level's ratio may be off before the lines' measurements are scaled; chosen."""


@dataclass(frozen=True, slots=True)
class _Look:
    """A frame: its crossings and lines; the track of each line, or -1; and the level that the map tells, or UNKNOWN."""

    crossings: Crossings
    lines: SeenLines
    track: Ints
    told: Ints


class Heights:
    """Between crossings and motion. While all lines are at one height nothing is changed.

    Attributes:
        misplaced: (N, 2) in base, where crossings of the last frame were taken to be until it told their heights.
        suspicion: what the frames before it showed to be wrong with the ceiling, for people; "" for nothing.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._mount, self._level_from_ceiling = calibration.mount_xy_m, calibration.level_from_ceiling
        self._height_m, self._sharp = calibration.ceiling_height_m, Sharpness.of(calibration)
        self.state = HeightsState()
        self._look: _Look | None = None
        self.misplaced = np.zeros((0, 2))
        self.suspicion = ""

    @property
    def several(self) -> bool:
        """Whether lines at other heights were found."""
        return len(self.state.levels) > 1

    @property
    def wants_whole_look(self) -> bool:
        """Whether edges are not where those of one plane would be: then predicted ones are not enough."""
        ratio, sigma = self.state.tracks.ratios(self._sharp)
        strange = (np.abs(ratio - 1.0) > _STRANGE) & (sigma < _TELLING) & (self.state.tracks.missing == 0)
        return self.several or bool(np.any(strange))

    def know(self, drops_m: Sequence[float]) -> None:
        """Begin with heights that an earlier run found, each so much lower than the calibrated one."""
        remembered = Levels.of_drops(drops_m, self._height_m)
        self.state = HeightsState(remembered=remembered, asks=len(remembered) > 1)

    @property
    def drops_m(self) -> tuple[float, ...]:
        """How much lower than the calibrated height the others are, those that were not met again included."""
        s = self.state
        met = s.levels.drops_m(self._height_m)
        return (*met, *s.remembered.without(s.levels).drops_m(self._height_m))

    def look(self, crossings: Crossings | None, expected: Array | None, ask_map: AskMap = no_map) -> Crossings | None:
        """The crossings where they are; those whose height is not known are left out, with points if there are several.

        Args:
            expected: (3,) motion since the last frame.
            ask_map: asked only where lines do not tell their heights: new ones may be at one of an earlier run.
        """
        s = self.state
        self._look = None
        if crossings is None or not crossings.directed:
            return crossings
        crossed = crossings.of(crossings.crossing_type < LINE_CROSSINGS) if has_points(crossings) else crossings
        if not len(crossed):
            return crossings
        moved = np.zeros(3) if expected is None else expected
        turned = -crossings.psi_rad if s.turned_rad is None else s.turned_rad + float(moved[2])
        lines = SeenLines.of(crossed, self._mount, turned)
        ratio = s.levels.ratio[np.maximum(s.tracks.level, 0)]
        track = s.tracks.followed(lines, s.camera_m + self._way(moved), ratio)
        level, told = np.full(len(lines), UNKNOWN), np.full(len(lines), UNKNOWN)
        if len(s.tracks):
            level = np.where(track >= 0, s.tracks.level[track], UNKNOWN)
        may_be_lower = s.asks or (len(s.remembered) > 1 and bool(np.any(track < 0)))
        asks = _few(level[lines.of_crossing]) if self.several else may_be_lower
        here = ask_map(expected) if asks else None
        if here is not None:
            told = self._told(crossed, lines, here)
            level = np.where(level == UNKNOWN, told, level)
        self._look = _Look(crossed, lines, track, told)
        return self._placed(crossed, lines.normals, level[lines.of_crossing]) if self.several else crossings

    def _told(self, crossings: Crossings, lines: SeenLines, here: MapHere) -> Ints:
        """(L,) levels by the map; heights of an earlier run are there again once it shows a line at one of them."""
        s = self.state
        levels = s.levels if self.several else s.remembered
        told = levels_by_map(crossings, lines.of_crossing, self._mount, here, levels.ratio)
        if not self.several:
            few = _few(told[lines.of_crossing])
            s.asks &= few
            if not few and np.any(told > 0):
                s.levels, s.settled = levels, True
        return told if self.several else np.full(len(lines), UNKNOWN)

    def reference(self) -> Crossings | None:
        """The crossings of the frame that motion is measured against, as their heights are known now."""
        s = self.state
        if not self.several or s.reference is None or not len(s.tracks):
            return None
        row = np.minimum(np.searchsorted(s.tracks.name, s.names), len(s.tracks) - 1)
        level = np.where(s.tracks.name[row] == s.names, s.tracks.level[row], UNKNOWN)
        return self._placed(s.reference, rotation(s.reference.psi_rad).T, level)

    def learn(self, motion: Motion) -> None:
        """What the motion says about the lines of the frame that was looked at last."""
        s = self.state
        self.misplaced, self.suspicion = np.zeros((0, 2)), SLOPES if s.slopes else ""
        s.told(motion.ok or motion.restarted)
        s.camera_m = s.camera_m + self._way(motion.prev_from_curr)
        turned = (s.turned_rad or 0.0) + float(motion.prev_from_curr[2])
        s.reference = None
        if self._look is None:
            s.turned_rad = turned if s.turned_rad is not None else None
            return
        look = self._look
        psi, first = look.crossings.psi_rad, s.turned_rad is None
        s.turned_rad = -psi if first else round((psi + turned) / _QUARTER_RAD) * _QUARTER_RAD - psi
        track = look.track
        if motion.restarted:
            s.tracks, track = Tracks(), np.full(len(look.lines), -1)
        new = int(np.count_nonzero(track < 0))
        s.tracks, track = s.tracks.seen_again(look.lines, track, s.camera_m, s.next_name)
        s.next_name += new
        s.tracks.level[track] = np.where(s.tracks.level[track] == UNKNOWN, look.told, s.tracks.level[track])
        if motion.ok or motion.restarted:
            s.tracks.measure(track, self._sharp)
            s.reference, s.names = look.crossings, s.tracks.name[track][look.lines.of_crossing]
        self._assign(look.lines, track)
        lost = s.tracks.lost()
        if self.several:
            s.levels.refine(np.where(s.tracks.own, s.tracks.level, UNKNOWN), *self._ratios(), lost)
            number = s.levels.merged()
            s.tracks.level = np.where(s.tracks.level == UNKNOWN, UNKNOWN, number[s.tracks.level])
        if np.any(lost):
            s.tracks = s.tracks.of(~lost)

    # -- which line is on which level

    def _assign(self, lines: SeenLines, track: Ints) -> None:
        s, t = self.state, self.state.tracks
        crossed = np.bincount(track[lines.of_crossing].ravel(), minlength=len(t))
        self._found(crossed)
        if not self.several:
            return
        first = not s.settled
        before = np.zeros_like(t.level) if first else t.level
        ratio, sigma = self._ratios()
        at, miss, second = s.levels.nearest(ratio, sigma)
        says = (miss < 1.0) & ((sigma < _TELLING) | ((sigma < _VAGUE) & (second > 1.0)))
        against = np.abs(ratio - s.levels.ratio[np.maximum(t.level, 0)]) > np.maximum(SIGMAS * sigma, SAME)
        t.own = (says | t.own) & ~(against & ~says)
        level = np.where(says, at, np.where(t.own, t.level, UNKNOWN))
        voted = self._voted(lines, track, level)
        off = np.abs(ratio - s.levels.ratio[np.maximum(voted, 0)])
        fits = (level == UNKNOWN) & (voted != UNKNOWN) & ~(off > np.maximum(SIGMAS * sigma, SAME))
        t.level = np.where(fits, voted, level)
        changed = (before != UNKNOWN) & (t.level != before)
        self._note_misplaced(lines, track, changed, before)
        if first:
            t.forget_measurements()
            s.settled = True

    def _found(self, crossed: Ints) -> None:
        """List heights that are new.

        Args:
            crossed: (T,) crossings of each line in this frame.
        """
        s, t = self.state, self.state.tracks
        parallax_m = self._sharp.coarse * _PARALLAX_M
        ratio, sigma = self._ratios()
        unlisted = s.levels.unlisted(ratio, sigma)
        if s.slopes or not np.any(unlisted) or s.fails:
            return
        known = (crossed >= _CROSSED) & t.steady(self._sharp)
        new = unlisted & known & (s.levels.apart(ratio) * t.ways_m() > parallax_m)
        s.slopes = bool(np.any(new)) and t.slopes(ratio, sigma, self._sharp)
        if s.slopes or not np.any(new):
            return
        if not self.several:
            factor = self._factor(ratio, sigma, crossed)
            if factor != 1.0:
                t.rescaled(factor)
                ratio, sigma = self._ratios()
                new = s.levels.unlisted(ratio, sigma) & known & (s.levels.apart(ratio) * t.ways_m() > parallax_m)
        near = np.abs(ratio[:, None] - ratio) < np.maximum(SAME, 2.0 * np.hypot(sigma[:, None], sigma))
        near &= (sigma < 2.0 * _TELLING) & known & s.levels.unlisted(ratio, sigma)  # not: vague, and on a level
        near &= (np.abs(t.apparent_m[:, None] - t.apparent_m) > _APART_M) | (t.axis[:, None] != t.axis)
        alike = np.count_nonzero(near, axis=1) + 1
        long = (t.sums[:, 0] >= _LONG) & (sigma < _SURE)
        for k in np.argsort(-alike, kind="stable"):
            if not new[k] or not believed(float(ratio[k]), int(alike[k]), bool(long[k])):
                continue
            of = near[k] | (np.arange(len(t)) == k)
            mean, own = float(np.average(ratio[of], weights=sigma[of] ** -2.0)), float(np.min(sigma[of]))
            if s.levels.unlisted(np.array([mean]), np.array([own]))[0]:
                s.levels.found(mean, own if s.settled else max(own, _FIRST_SIGMA))
                if not s.settled:  # the others are told apart once the way is by one height
                    return

    def _note_misplaced(self, lines: SeenLines, track: Ints, changed: Bools, before: Ints) -> None:
        """Where crossings were taken to be of lines that turn out to be at another height."""
        assert self._look is not None
        rows = track[lines.of_crossing]
        which = np.flatnonzero(np.any(changed[rows], axis=1))
        if len(which):
            was = np.where(np.any(before[rows[which]] == UNKNOWN, axis=1)[:, None], 0, before[rows[which]])
            higher = 1.0 / self.state.levels.ratio[np.maximum(was, 0)]
            from_camera = (self._look.crossings.xy_base_m[which] - self._mount) @ lines.normals.T
            self.misplaced = self._mount + (from_camera * higher) @ lines.normals

    def _ratios(self) -> tuple[Array, Array]:
        """As Tracks.ratios(), by the calibrated level's lines of the same axis: what is wrong with the way along it is
        in theirs as well."""
        t = self.state.tracks
        ratio, sigma = t.ratios(self._sharp)
        if not self.several:
            return ratio, sigma
        main = t.own & (t.level == 0) & np.isfinite(sigma)
        for axis in (0, 1):
            of = main & (t.axis == axis)
            if float(np.sum(sigma[of] ** -2.0)) >= _ANCHORED:
                ratio[t.axis == axis] /= float(np.average(ratio[of], weights=sigma[of] ** -2.0))
        return ratio, sigma

    def _voted(self, lines: SeenLines, track: Ints, level: Ints) -> Ints:
        """(T,) the level that most of the lines are on which cross each, or UNKNOWN."""
        t, levels = self.state.tracks, len(self.state.levels)
        rows = track[lines.of_crossing]
        votes = np.zeros((len(t), levels))
        for one, other in ((0, 1), (1, 0)):
            says = t.own[rows[:, other]]
            np.add.at(votes, (rows[says, one], level[rows[says, other]]), 1.0)
        total, best = votes.sum(axis=1), np.argmax(votes, axis=1)
        every = np.arange(len(t))
        clear = (total > 0) & (votes[every, best] >= _MAJORITY * total)
        own = votes[every, np.maximum(t.level, 0)]
        stays = (t.level != UNKNOWN) & ((own >= _MINORITY * total) | (total - own < _OUTVOTED))
        return np.where(stays, t.level, np.where(clear, best, UNKNOWN))

    def _factor(self, ratio: Array, sigma: Array, crossed: Ints) -> float:
        """By how much the way was too long while lines of several heights were taken for ones of one height."""
        known = np.flatnonzero(sigma < 2.0 * _TELLING)
        near = np.abs(ratio[known, None] - ratio[known]) < np.maximum(0.5 * sigma[known], SAME)
        weight = near @ np.minimum(crossed[known], _MOST_SAY).astype(np.float64)
        if not len(known) or not np.any(weight):
            return 1.0
        likely = np.flatnonzero(weight >= _HIGHEST * np.max(weight))
        best = near[likely[np.argmin(ratio[known][likely])]]
        centre = float(np.average(ratio[known][best], weights=sigma[known][best] ** -2.0))
        return 1.0 if abs(centre - 1.0) < _ALIKE else 1.0 / centre

    # -- where things are

    def _way(self, moved: Array) -> Array:
        """(2,) of the camera along the fixed axes, for a motion (3,)."""
        in_base = rotation(float(moved[2])) @ self._mount + moved[:2] - self._mount
        return np.asarray(rotation(self.state.turned_rad or 0.0) @ in_base)

    def _placed(self, crossings: Crossings, normals: Array, level: Ints) -> Crossings:
        """Those of known height, where they are.

        Args:
            level: (M, 2) of each crossing's two lines.
        """
        levels = self.state.levels
        known: Bools = np.all(level != UNKNOWN, axis=1)
        if np.count_nonzero(known) < _FEWEST:
            known = np.ones(len(level), bool)
        which = np.flatnonzero(known)
        usual = int(np.argmax(np.bincount(level[level != UNKNOWN], minlength=1)))  # what is not known is as the rest
        at = np.where(level[which] == UNKNOWN, usual, level[which])
        part = replace(crossings.of(which), complete=len(which) >= _COMPLETE * len(level), several=True)
        if not np.any(at):
            return part
        higher = 1.0 / levels.ratio[at]
        sigma = higher**2 * np.where(at > 0, levels.info[at] ** -0.5, 0.0)
        from_camera = (part.xy_base_m - self._mount) @ normals.T
        xy = self._mount + (from_camera * higher) @ normals
        scale = np.einsum("ki,mk,kj->mij", normals, higher, normals)
        cov = scale @ (part.cov_base_m2 - part.common_cov_m2) @ scale + part.common_cov_m2
        cov += np.einsum("mk,ki,kj->mij", (sigma * from_camera) ** 2, normals, normals)
        return replace(part, xy_base_m=xy, cov_base_m2=cov, uv_px=to_ceiling(self._level_from_ceiling, xy))


def _few(level: Ints) -> bool:
    """Whether of the crossings (M, 2) of two levels too few are known."""
    return bool(np.count_nonzero(np.all(level != UNKNOWN, axis=1)) < max(_ASKS * len(level), _FEWEST))
