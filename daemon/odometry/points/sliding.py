"""Points that slide over the ceiling while the robot drives: mirror images of lights, which are no part of it.

A mirror shows a light as far above the ceiling as it is below. So its image moves past slower than the ceiling does,
and from one frame to the next by millimetres only, within what a point may be off by; but always alike. How far a point
moves with the camera, as a part of its way, is measured over some centimetres. What is nearer than the ceiling moves
past faster; that is another height (heights/), and not looked at here.
"""

from __future__ import annotations

from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.crossing_types import LAMP, LINE_CROSSINGS
from ceilvo.daemon.odometry import kernel
from ceilvo.daemon.odometry.points.constellation import has_lines, has_points
from ceilvo.daemon.odometry.points.sliding_state import SlidingState
from ceilvo.types import Array, Crossings, Ints, Motion

Bools = NDArray[np.bool_]

_GATE_M = 0.03
"""How far from where it was expected a feature may be; chosen: a new one, of which nothing is known, at 1.5 m/s."""
_PATIENCE = 4
"""Frames in a row in which a feature may be missing, as for lines (heights/tracks.py)."""
_STEP_M = 0.004
"""It is measured again once the camera has moved so far, as for lines."""
_SIGMA_M, _INDEPENDENT = 0.001, 8.0
"""Of a point's place over some centimetres, and measurements that err on their own, at most; chosen: more than lines
have (0.4 mm), for a blob's middle is less well defined."""
_FEWEST = 5
"""Measurements that tell how a feature moves; chosen: edges of lamps in a row, taken for each other, made three alike.
"""
_STEADY_M = 0.003
"""It moves evenly whose places scatter by no more about a straight share; chosen: else two are followed by turns."""
_SLIDES, _MOST, _SIGMAS = 0.12, 0.7, 4.0
"""Share of the camera's way from which a point is an image, up to which it is, and standard deviations that it must be
above the ceiling's; chosen: of a light more than 0.3 m below a ceiling of 2.2 m, for a nearer one errs by less than a
lens does; and one that stands on the floor, 2.7 m below, goes 0.55."""
_CARRIED_M, _STAYS_M = 0.5, 0.01
"""Way on which the image of a light on the robot itself stays where it was in base, within the latter; chosen."""
_KNOWN = 0.04
"""Standard deviation of a share by which it is expected to have moved; chosen: a third of what is looked for."""
_SWAYS = 2.0
"""Standard deviations of a sway that the way may be; chosen."""
_LEAST_TOLD = 0.2
"""Part of its own way that odometry tells at least; chosen, not to divide by 0."""
_REFERENCES = 3
"""Features other than lamps that tell how the ceiling itself moves; chosen."""
_TRIAL, _TRIAL_LINES = 10, 6
"""Frames for which lamps that come in where lines sufficed do not count until they are known to stay, twice what that
takes at 0.1 m/s and more; and crossings of lines in a frame that does without them; chosen."""

_PER_TRACK = [f.name for f in fields(SlidingState) if f.name not in ("pose", "glossy", "by_lines", "trial")]


class Sliding:
    """Leaves out of a view what slides; `state` is what it remembers.

    Attributes:
        misplaced: (N, 2) in base, points of the last frame that were taken for the ceiling's until it.
    """

    def __init__(self, mount_xy_m: Array, height_m: float, coarse: float = 1.0) -> None:
        """coarse: how many times larger a camera's errors are than those that the constants are of."""
        self._mount, self._height_m, self._coarse = mount_xy_m, height_m, coarse
        self._look: tuple[Crossings, Ints] | None = None
        self.misplaced = np.zeros((0, 2))

    def look(self, s: SlidingState, crossings: Crossings | None, expected: Array | None) -> Crossings | None:
        """The crossings of a frame without what slides; expected: (3,) motion since the last one."""
        self._look = None
        if crossings is None or not (len(s) or has_points(crossings)):
            return crossings
        pose = s.pose if expected is None else se2.compose(s.pose, expected)
        by_lines = int(np.count_nonzero(crossings.crossing_type < LINE_CROSSINGS))
        if not len(s) and s.by_lines:
            s.trial = _TRIAL
        track = self._followed(s, crossings, pose)
        self._look = crossings, track
        if not has_points(crossings):
            return crossings
        left_out = _of(s.slides, track)
        if s.glossy or (s.trial and by_lines >= _TRIAL_LINES):
            left_out |= (crossings.crossing_type == LAMP) & ~_of(s.stays, track)
        return crossings.of(~left_out) if np.any(left_out) else crossings

    def learn(self, s: SlidingState, motion: Motion, sway_m: float = 0.0) -> None:
        """What the motion says about the features of the frame that was looked at last.

        Args:
            sway_m: standard deviation by which leans move the view where no lines tell them: its rim moves further.
        """
        self.misplaced = np.zeros((0, 2))
        if motion.ok or motion.restarted:
            s.by_lines = motion.ok and self._look is None
        s.trial = max(s.trial - 1, 0)
        if self._look is None and not len(s):
            return
        s.pose = se2.compose(s.pose, motion.prev_from_curr)
        if motion.restarted:
            _keep(s, np.zeros(0, np.int64))
        if self._look is None:
            s.missing += 1
        else:
            crossings, track = self._look
            self._see(s, crossings, np.full(len(track), -1) if motion.restarted else track, sway_m)
        _keep(s, np.flatnonzero(s.missing <= _PATIENCE))

    def _see(self, s: SlidingState, crossings: Crossings, track: Ints, sway_m: float) -> None:
        kind, xy, camera = _kind(crossings), se2.transform(s.pose, crossings.xy_base_m), self._camera(s.pose)
        new = np.flatnonzero(track < 0)
        _grow(s, kind[new], xy[new], camera, crossings.xy_base_m[new])
        track = track.copy()
        track[new] = np.arange(len(s) - len(new), len(s))
        s.missing += 1
        s.missing[track] = 0
        s.xy[track], s.camera[track], s.last[track] = xy, camera, crossings.xy_base_m
        far = track[~(np.hypot(*(camera - s.measured[track]).T) < _STEP_M)]
        s.measured[far] = camera
        s.sums[far] += _sums(s.xy[far], camera, 0.0 if has_lines(crossings) else self._height_m**-2)
        before = s.slides.copy()
        _judge(s, sway_m, self._coarse)
        found = np.flatnonzero((s.slides & ~before)[track])
        self.misplaced = crossings.xy_base_m[found]

    def _followed(self, s: SlidingState, crossings: Crossings, pose: Array) -> Ints:
        """(N,) the track of each feature, or -1."""
        track = np.full(len(crossings), -1)
        if len(s):
            share, sigma = _shares(s, self._coarse)[:2]
            moved = np.where(sigma < _KNOWN, share, 0.0)[:, None] * (self._camera(pose) - s.camera)
            seen = se2.transform(pose, crossings.xy_base_m)
            gate_m = self._coarse * _GATE_M
            i, j = kernel.mutual_nearest(seen, _kind(crossings), s.xy + moved, s.kind, gate_m)
            track[i] = j
        return track

    def _camera(self, pose: Array) -> Array:
        return np.asarray(se2.transform(pose, self._mount[None])[0])


def _of(which: Bools, track: Ints) -> Bools:
    """(N,) those of tracks (T,) that features have whose tracks are (N,), or -1."""
    return np.append(which, False)[track]


def _kind(crossings: Crossings) -> Ints:
    return np.where(crossings.crossing_type < LINE_CROSSINGS, 0, crossings.crossing_type)


def _keep(s: SlidingState, which: Ints) -> None:
    if len(which) < len(s):
        for name in _PER_TRACK:
            setattr(s, name, getattr(s, name)[which])


def _grow(s: SlidingState, kind: Ints, xy: Array, camera: Array, base: Array) -> None:
    n = len(kind)
    more = SlidingState(
        kind=kind,
        xy=xy,
        camera=np.tile(camera, (n, 1)),
        measured=np.full((n, 2), np.nan),
        first=base,
        last=base,
        sums=np.zeros((n, 9)),
        missing=np.zeros(n, np.int64),
        slides=np.zeros(n, bool),
        stays=np.zeros(n, bool),
    )
    for name in _PER_TRACK:
        setattr(s, name, np.concatenate([getattr(s, name), getattr(more, name)]))


def _sums(at: Array, camera: Array, leans: float) -> Array:
    """(N, 9) a measurement of features at (N, 2), as SlidingState.sums has them; leans: over height squared, m^-2."""
    one = np.ones(len(at))
    rim = leans * np.sum((at - camera) ** 2, axis=1)
    columns = [one, one * camera[0], one * camera[1], at, one * (camera @ camera), at @ camera, np.sum(at**2, axis=1)]
    return np.column_stack([*columns, rim])


def _moved(s: SlidingState) -> tuple[Array, Array]:
    """(T,) measurements of each, 1 at least; and (T,) the sum of squares of the camera's way from its middle, m^2."""
    n = np.maximum(s.sums[:, 0], 1.0)
    return n, np.maximum(s.sums[:, 5] - np.sum(s.sums[:, 1:3] ** 2, axis=1) / n, 0.0)


def _shares(s: SlidingState, coarse: float) -> tuple[Array, Array, Bools]:
    """(T,) what part of the camera's way each moves with it; its standard deviation, infinite where not measured; and
    whether it moves evenly."""
    (n, way2), c, p, (cp, pp) = _moved(s), s.sums[:, 1:3], s.sums[:, 3:5], s.sums[:, 6:8].T
    some = (s.sums[:, 0] >= _FEWEST) & (way2 > _STEP_M**2)
    way2 = np.where(some, way2, 1.0)
    share = np.where(some, (cp - np.sum(c * p, axis=1) / n) / way2, 0.0)
    sigma = coarse * _SIGMA_M * np.sqrt(n / np.minimum(n, _INDEPENDENT) / way2)
    left = pp - np.sum(p * p, axis=1) / n - share**2 * way2
    return share, np.where(some, sigma, np.inf), some & (left <= n * (coarse * _STEADY_M) ** 2)


def _judge(s: SlidingState, sway_m: float, coarse: float) -> None:
    """Say which ones slide and which stay."""
    share, sigma, even = _shares(s, coarse)
    ceiling, own = _ceilings_share(s, share, sigma, even)
    told = max(1.0 - ceiling, _LEAST_TOLD)  # of the camera's way, by what it sees: the rest is what images did to it
    beyond = (share - ceiling) / told
    unsure = _SIGMAS * np.hypot(sigma, own) / told + _by_leans(s, sway_m)
    carried = np.isfinite(own) & (_way_m(s) > _CARRIED_M) & (np.hypot(*(s.last - s.first).T) < _STAYS_M)
    image = even & (beyond > np.maximum(_SLIDES, unsure)) & (beyond < _MOST)
    slides = (image | carried) & (s.kind >= LINE_CROSSINGS)
    stays = even & (beyond + unsure < _SLIDES)
    s.slides, s.stays = slides | s.slides & ~stays, stays | s.stays & ~slides
    s.glossy |= bool(np.any(slides & (s.kind == LAMP)))


def _ceilings_share(s: SlidingState, share: Array, sigma: Array, even: Bools) -> tuple[float, float]:
    """What part of the way the ceiling itself moves, which is 0 but for what images do to the odometry; and the
    standard deviation of that, infinite where it is not known.

    Told by crossings, corners and spots, where there are; else by lamps that stayed, or at first by the two that move
    past fastest.
    """
    known = np.isfinite(sigma)
    others = known & (s.kind != LAMP) & ~s.slides
    if np.count_nonzero(others) >= _REFERENCES:
        return _share_of_most(share, sigma, others & even, int(np.count_nonzero(others)))
    if not s.glossy:
        return _share_of_fastest(share, sigma, known & even & (s.kind == LAMP))
    stays = known & s.stays
    return (float(np.median(share[stays])), float(np.median(sigma[stays]))) if np.any(stays) else (0.0, 0.0)


def _share_of_most(share: Array, sigma: Array, even: Bools, count: int) -> tuple[float, float]:
    """By those that move evenly (T,), where half of all `count` do, and alike; else not known."""
    if not np.any(even):
        return 0.0, np.inf
    middle = float(np.median(share[even]))
    alike = even & (np.abs(share - middle) < _SLIDES)
    enough = np.count_nonzero(alike) >= max(_REFERENCES, 0.5 * count)
    return (middle, float(np.median(sigma[alike]))) if enough else (0.0, np.inf)


def _share_of_fastest(share: Array, sigma: Array, lamps: Bools) -> tuple[float, float]:
    """By the two lamps (T,) that move past fastest of those that move alike."""
    order = np.flatnonzero(lamps)
    order = order[np.argsort(share[order], kind="stable")]
    alike = np.flatnonzero(np.diff(share[order]) < np.hypot(sigma[order[1:]], sigma[order[:-1]]))
    return (float(share[order[alike[0]]]), float(sigma[order[alike[0]]])) if len(alike) else (0.0, np.inf)


def _by_leans(s: SlidingState, sway_m: float) -> Array:
    """(T,) what leans of a robot whose tilt nothing tells may add to a share."""
    rim = np.max(s.sums[:, 8] / _moved(s)[0], initial=0.0)
    return rim * np.minimum(_SWAYS * sway_m / np.maximum(_way_m(s), _STEP_M), 1.0)


def _way_m(s: SlidingState) -> Array:
    """(T,) how far the camera moved while each was measured, were it evenly."""
    n, way2 = _moved(s)
    return np.sqrt(12.0 * way2 / n)
