"""Pictures that have been seen before: a ring of old buffers, or one buffer with noise that no camera has.

A live camera has noise of its own in every picture. Two pictures that differ by clearly less than that are one picture.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.odometry import kernel
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity, Suspicion
from ceilvo.types import Array, Crossings, Ints, Motion

RING = 12
"""Pictures compared with; chosen: drivers have 2 to 8 buffers, and 12 pictures are 0.4 s at 30 Hz (delay.py)."""
_CALM_SHARE = 0.75
"""Of the samples, those that differ least: the others lie on edges, which move with the robot; chosen."""
_FEWEST_SAMPLES = 128
"""Neither black nor glaring ones that a comparison needs; chosen: the mean of 3/4 of them is known to 8 %."""
_BLACK, _GLARE = 2, 253
"""Grey levels beyond which a sensor shows no noise."""
_QUIET = 0.5
"""Of a standing camera's difference, below which two pictures are one. 20 standing pictures had 0.93 to 1.1 of their
mean, at noise 0.3 to 3 times the simulator's; one picture with its last bit random 0.29, at 1 times; measured with
tests/daemon/odometry/cross_checks/test_pictures.py's scenes."""
_LEAST_NEAR = 0.5 * _CALM_SHARE
"""Of the samples, within twice the difference of _QUIET, in two pictures that may be one: with fewer, half of the calm
ones are above it, and so their mean is above _QUIET."""
_LEAST_NOISE_GREY = 0.2
"""Difference of standing pictures below which the camera shows too little noise to judge by; chosen: grey levels are
whole numbers, so most of the calm samples are equal then."""
_EQUAL_SHARE = 0.995
"""Of the samples, equal in two pictures that are one: 1 in 5 differed at noise 0.1 times the simulator's, the noise of
rounding alone."""
_EQUAL_MOVING = 0.7
"""Of the samples, equal in two pictures of a moving camera, below which its pictures are never equal by nature: 1 in 4
at the simulator's noise, nearly all without noise; chosen."""
_MOVING_FRAMES = 10.0
"""Moving pictures that their usual share is the mean over; chosen."""
_NOISELESS_GREY = 1e-6
"""Stands for no noise at all, where 0 says that it is not known."""
_EQUAL_SIGMAS = 0.01
"""Of the crossings' own error, rms, that is none where there are no samples: standing pictures had 0.056 at the least
(noise 0.1 times the simulator's), one picture with one random bit 0.002."""
_LIGHT_CHANGED = 0.05
"""Relative change of brightness from one standing picture to the next after which noise is learnt anew; chosen."""
_DIMMER = 0.7
"""Of the brightness at which noise was learnt: darker pictures have less noise; chosen."""
STANDS_M, STANDS_RAD = 0.0005, 0.0003
"""Motion of a standing picture, five times the noise of one frame; chosen."""
MOVES_M, MOVES_RAD = 0.002, 0.002
"""Motion that proves that the pictures are live; chosen."""
_LEARNT_FRAMES = 5
"""Standing pictures that tell the noise; chosen."""


@dataclass(frozen=True, slots=True)
class Picture:
    """What is kept of a picture: samples (S,) of its grey levels, crossings (M, 2) m with their types (M,)."""

    sample: NDArray[np.uint8]
    xy_base_m: Array
    crossing_type: Ints
    sigma_m: float


@dataclass(slots=True)
class PicturesState:
    """Pictures of the last frames and the camera's noise.

    Attributes:
        last: oldest first, RING at most.
        noise_grey: mean difference of two standing pictures, the calm share of the samples; 0 = not known.
        noise_mean_grey: mean brightness then.
        candidate_grey, candidate_frames: the least difference of this stand and its pictures; they count once the
            picture has moved, which a frozen one does not.
        equal_moving: usual share of samples that are equal in two pictures in a row of a moving camera; 1 at first.
    """

    last: list[Picture] = field(default_factory=list)
    noise_grey: float = 0.0
    noise_mean_grey: float = 0.0
    candidate_grey: float = 0.0
    candidate_frames: int = 0
    equal_moving: float = 1.0


class Pictures:
    """Compares a picture with the last ones."""

    def __init__(self) -> None:
        self.state = PicturesState()
        self._newest: tuple[Crossings, Picture] | None = None

    def judge(self, crossings: Crossings, wheels_stand: bool) -> Suspicion | None:
        """Whether a picture is one of the last ones; changes nothing.

        Args:
            wheels_stand: they say that the robot does not move, so two pictures in a row may be alike.
        """
        new, s = self._picture(crossings), self.state
        if not s.last or not len(crossings):
            return None
        newest_first = s.last[::-1]
        like = self._may_be(new, newest_first)
        periods = [k + 1 for k, old in enumerate(newest_first) if like[k] and self._same(new, old)]
        if not periods or (wheels_stand and periods[0] == 1):
            return None
        if periods[0] == 1:
            return Suspicion(Kind.FROZEN, "the picture is the last one again: the camera is frozen", Severity.UNUSABLE)
        why = f"the picture is the one {periods[0]} frames before again: the camera repeats old buffers"
        return Suspicion(Kind.REPEATS, why, Severity.UNUSABLE, period=periods[0])

    def _may_be(self, new: Picture, old: list[Picture]) -> NDArray[np.bool_]:
        """(N,) a first look at all at once: pictures of which hardly any sample is like the new one's are others."""
        alike = [len(p.sample) == len(new.sample) for p in old]
        if not len(new.sample) or not all(alike):
            return np.ones(len(old), bool)
        before = np.stack([p.sample for p in old])
        near = kernel.alike(new.sample, before, 2.0 * _QUIET * self.state.noise_grey, _BLACK, _GLARE)
        return np.asarray(near / len(new.sample) >= _LEAST_NEAR)

    def add(self, crossings: Crossings, motion: Motion) -> None:
        """Keep a picture, refused ones as well, and learn the camera's noise from pictures that stand."""
        new, s = self._picture(crossings), self.state
        if s.last:
            self._learn(new, s.last[-1], motion)
        s.last = [*s.last[-RING + 1 :], new]

    def _picture(self, crossings: Crossings) -> Picture:
        """What is kept of them; the same frame is asked for twice."""
        if self._newest is None or self._newest[0] is not crossings:
            self._newest = crossings, _picture(crossings)
        return self._newest[1]

    def _learn(self, new: Picture, before: Picture, motion: Motion) -> None:
        s = self.state
        moved_m, turned_rad = float(np.hypot(*motion.prev_from_curr[:2])), abs(float(motion.prev_from_curr[2]))
        difference = _difference(new, before)
        if difference is None or not motion.ok:
            s.candidate_frames = 0
        elif moved_m > MOVES_M or turned_rad > MOVES_RAD:
            if s.candidate_frames >= _LEARNT_FRAMES:
                s.noise_grey = max(s.candidate_grey, _NOISELESS_GREY)
                s.noise_mean_grey = float(new.sample.mean())
            s.candidate_frames = 0
            s.equal_moving += (float(np.mean(new.sample == before.sample)) - s.equal_moving) / _MOVING_FRAMES
        elif moved_m < STANDS_M and turned_rad < STANDS_RAD:
            self._stand(new, before, difference)

    def _stand(self, new: Picture, before: Picture, difference: float) -> None:
        s, mean, last_mean = self.state, float(new.sample.mean()), float(before.sample.mean())
        if abs(mean - last_mean) > _LIGHT_CHANGED * last_mean:
            s.candidate_frames, s.noise_grey = 0, 0.0
            return
        s.candidate_grey = min(difference, s.candidate_grey) if s.candidate_frames else difference
        s.candidate_frames += 1

    def _same(self, a: Picture, b: Picture) -> bool:
        difference, s = _difference(a, b), self.state
        if difference is None:
            return _same_crossings(a, b)
        known = s.noise_grey > _LEAST_NOISE_GREY and float(a.sample.mean()) > _DIMMER * s.noise_mean_grey
        quiet = known and difference < _QUIET * s.noise_grey
        return quiet or (self._never_equal and float(np.mean(a.sample == b.sample)) > _EQUAL_SHARE)

    @property
    def _never_equal(self) -> bool:
        """Whether two pictures of this camera differ: one that stood equal and then moved is live without noise."""
        s = self.state
        return s.noise_grey > _LEAST_NOISE_GREY or (s.noise_grey == 0.0 and s.equal_moving < _EQUAL_MOVING)


def _picture(crossings: Crossings) -> Picture:
    own = np.einsum("mii->mi", crossings.cov_base_m2) - np.diag(crossings.common_cov_m2)
    sigma_m = float(np.sqrt(np.mean(own))) if len(crossings) else 0.0
    return Picture(crossings.sample_gray, crossings.xy_base_m, crossings.crossing_type, sigma_m)


def _difference(a: Picture, b: Picture) -> float | None:
    """Mean absolute difference, grey levels, of the calm share of the samples; None without enough of them."""
    if len(a.sample) != len(b.sample):
        return None
    clear, difference = kernel.calm_difference(a.sample, b.sample, _CALM_SHARE, _BLACK, _GLARE)
    return difference if clear >= _FEWEST_SAMPLES else None


def _same_crossings(a: Picture, b: Picture) -> bool:
    if len(a.xy_base_m) != len(b.xy_base_m) or not np.array_equal(a.crossing_type, b.crossing_type):
        return False
    rms_m = float(np.sqrt(np.mean((a.xy_base_m - b.xy_base_m) ** 2)))
    return rms_m <= _EQUAL_SIGMAS * a.sigma_m
