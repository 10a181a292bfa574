"""Scales of wheels and track, learnt from what the eye sees, and how much the wheels err beside.

State: three shares by which what the base reckons with is off: left wheel, right wheel and track, or x, y and theta of
an omnidirectional base. Stretches of a quarter of a metre by wheels and by eye are compared (an extended Kalman filter
with the derivative of the way by the scales). What is left over is noise, which grows with the way, and is learnt too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.config.sections.senses import Senses
from ceilvo.daemon.odometry.senses.reckoning import Reckoning, Step
from ceilvo.types import Array, WheelMotion

PARAMETERS = 3
_STRETCH_M, _TURN_M_PER_RAD = 0.25, 0.25
"""Way of a stretch, and how much way a radian of turning is for the wheels; chosen: several frames, and half a track of
.5 m."""
_LONGEST_S = 5.0
"""Of a stretch; chosen: vision's slow errors, and a robot that rests."""
_COMMISSIONED = np.array([1e-4, 1e-4, 1e-4, 4e-4])
"""[m^2/m, m^2/m, rad^2/m, rad^2/rad] of the wheels' noise before anything is learnt: ahead, sideways, of the heading by
way and by turning; 1 cm and .6 deg after a metre, 1.1 deg after a radian; as drivers/base/wheel_track.py."""
_QUIETEST, _LOUDEST = 0.01, 30.0
"""Of that, what may be learnt: 1 mm and .06 deg after a metre, to 5 cm and 3 deg; chosen."""
_GAIN, _LEAST_GAIN = 0.4, 0.04
"""Of the logarithm of the noise for a stretch that errs by twice its variance; at first, and after a while; chosen."""
_MOST_RATIO = 6.0
"""Of a squared error to its variance: a larger one is a slip, and teaches as much as this one does; chosen."""
_WALK_PM = 1e-4
"""Drift of a scale in a metre, by load and wear, as its root: .3 % in a kilometre; chosen."""
_GATE_CHI2 = 21.1
"""Squared error of a stretch, three degrees of freedom, that is a slip: noise exceeds it once in 10^4."""
_TINY = 1e-30
"""Against a division by nothing."""
_STAMP_S = 0.002
"""Standard deviation of when a count was taken; as drivers/base/wheel_track.py."""
_GRAIN_M, _GRAIN_RAD = 4e-5, 4e-6
"""Standard deviation of one count of the base: its units over the root of six."""


@dataclass(slots=True)
class WheelScalesState:
    """What is learnt.

    Attributes:
        off: (3,) shares by which the scales are off what the base reckons with, cov: their covariance (3, 3); set at
            the first stretch.
        noise: (4,) variances that a metre adds ahead, sideways and to the heading, and that a radian adds to that.
        taught: (4,) stretches that told each of them, as a sum of shares.
        stretches: learnt from; refused: taken for slips.
        by_wheels, by_eye: the stretch under way; eye_cov: (3, 3) error of one frame's motion.
        way_m, turned_rad: of that stretch; the way counts turns as well.
        twist: (3,) [m/s, m/s, rad/s] at its start.
        start_s: by how much later its start was counted than it was, as the stretch before, which ended there, tells;
            start_cov: (4,) covariances of that with the scales, and its variance.
    """

    off: Array = field(default_factory=lambda: np.zeros(PARAMETERS))
    cov: Array = field(default_factory=lambda: np.zeros((PARAMETERS, PARAMETERS)))
    noise: Array = field(default_factory=lambda: _COMMISSIONED.copy())
    taught: Array = field(default_factory=lambda: np.zeros(4))
    stretches: int = 0
    refused: int = 0
    by_wheels: Reckoning = field(default_factory=lambda: Reckoning.start(PARAMETERS))
    by_eye: Array = field(default_factory=lambda: np.zeros(3))
    way_m: float = 0.0
    turned_rad: float = 0.0
    twist: Array = field(default_factory=lambda: np.zeros(3))
    start_s: float = 0.0
    start_cov: Array = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, _STAMP_S**2]))


class WheelScales:
    """Of one robot."""

    def __init__(self, config: Senses) -> None:
        self._track_m = config.track_m if config.drive == "differential" else None
        self._prior = np.eye(PARAMETERS) * config.scale_sigma**2
        self._bound = config.scale_bound
        self.state = WheelScalesState(cov=self._prior.copy())

    @property
    def names(self) -> tuple[str, str, str]:
        return ("x", "y", "theta") if self._track_m is None else ("left", "right", "track")

    # -- what it says

    def step(self, wheels: WheelMotion) -> Step:
        """What wheels report (3,), with the scales that are known."""
        twist = se2.mean_twist(wheels.prev_from_curr, 1.0)
        by = self._by_scales(twist)
        true = twist + by @ self.state.off
        turned_rad, straight_m = abs(float(twist[2])), float(np.hypot(twist[0], twist[1]))
        ahead, across, by_way, by_turn = self.state.noise.tolist()
        way_m = straight_m + _TURN_M_PER_RAD * turned_rad
        grain = np.array([_GRAIN_M, _GRAIN_M, _GRAIN_RAD]) ** 2
        noise = np.array([ahead * way_m, across * way_m, by_way * straight_m + by_turn * turned_rad])
        return Step(true, by, np.diag(noise + grain))

    def _by_scales(self, twist: Array) -> Array:
        """(3, 3) derivative of a twist by the scales."""
        ahead, across, turn = twist.tolist()
        if self._track_m is None:
            return np.diag([ahead, across, turn])
        left, right = ahead - 0.5 * self._track_m * turn, ahead + 0.5 * self._track_m * turn
        return np.array(
            [
                [0.5 * left, 0.5 * right, 0.0],
                [0.0, 0.0, 0.0],
                [-left / self._track_m, right / self._track_m, -turn],
            ]
        )

    # -- what it learns

    def leave(self) -> None:
        """The stretch under way tells nothing: the eye saw nothing, or wheels slip."""
        self._begin()
        self.state.start_s, self.state.start_cov = 0.0, np.array([0.0, 0.0, 0.0, _STAMP_S**2])

    def _begin(self) -> None:
        s = self.state
        s.by_wheels, s.by_eye, s.way_m, s.turned_rad = Reckoning.start(PARAMETERS), np.zeros(3), 0.0, 0.0

    def learn(self, step: Step, seen: Array, seen_cov: Array, elapsed_s: float, late_sigma_s: float) -> None:
        """A frame by wheels, and by eye: (3,) prev_from_curr with (3, 3), where both saw it.

        Args:
            late_sigma_s: how well the delay between them is known.
        """
        s = self.state
        twist = step.twist / elapsed_s if elapsed_s > 0.0 else np.zeros(3)
        if s.way_m == 0.0:
            s.twist = twist
        s.by_wheels = s.by_wheels.then(step, elapsed_s)
        s.by_eye = se2.compose(s.by_eye, seen)
        way_m = float(np.hypot(step.twist[0], step.twist[1])) + _TURN_M_PER_RAD * abs(float(step.twist[2]))
        s.way_m, s.turned_rad = s.way_m + way_m, s.turned_rad + abs(float(step.twist[2]))
        if s.by_wheels.seconds > _LONGEST_S:
            self.leave()
        elif s.way_m >= _STRETCH_M:
            late = np.diag(((twist - s.twist) * late_sigma_s) ** 2)
            self._update(seen_cov + late, twist)
            self._begin()

    def _update(self, besides: Array, twist: Array) -> None:
        """A whole stretch; besides: (3, 3) what else it errs by than the wheels, twist: (3,) at its end.

        What its end was counted too late by, the next stretch has too little: so that is estimated beside the scales
        until then. As errors of their own in each stretch, ends would hide what the scales are.
        """
        s = self.state
        s.cov = s.cov + np.eye(PARAMETERS) * _WALK_PM**2 * s.way_m
        off = se2.between(s.by_wheels.way, s.by_eye)  # what the scales and noise must explain, in base at the end
        c, k = math.cos(float(s.by_wheels.way[2])), math.sin(float(s.by_wheels.way[2]))
        turn = np.array([[c, k, 0.0], [-k, c, 0.0], [0.0, 0.0, 1.0]])
        noise = turn @ s.by_wheels.noise @ turn.T
        h = np.column_stack([turn @ s.by_wheels.by_parameters, _carried(s.by_wheels.way) @ s.twist, -twist])
        cov = np.diag([0.0] * PARAMETERS + [0.0, _STAMP_S**2])
        cov[:PARAMETERS, :PARAMETERS] = s.cov
        cov[PARAMETERS, : PARAMETERS + 1] = cov[: PARAMETERS + 1, PARAMETERS] = s.start_cov
        total = h @ cov @ h.T + noise + besides
        new = off - h[:, PARAMETERS] * s.start_s
        weighed = np.linalg.solve(total, new)
        if float(new @ weighed) > _GATE_CHI2 * max(1.0, 3.0 - s.stretches):
            s.refused += 1
            s.start_s, s.start_cov = 0.0, np.array([0.0, 0.0, 0.0, _STAMP_S**2])
            return
        gain = cov @ h.T @ np.linalg.inv(total)
        keep = np.eye(len(cov)) - gain @ h
        change = gain @ new
        without_ends = h[:, :PARAMETERS] @ s.cov @ h[:, :PARAMETERS].T + noise + besides
        self._learn_noise(off, np.diagonal(without_ends), np.diagonal(noise))  # rather too much than too little
        cov = keep @ cov @ keep.T + gain @ (noise + besides) @ gain.T
        s.off = np.clip(s.off + change[:PARAMETERS], -self._bound, self._bound)
        s.cov = cov[:PARAMETERS, :PARAMETERS].copy()
        s.start_s = float(change[-1])
        s.start_cov = np.append(cov[-1, :PARAMETERS], cov[-1, -1])
        s.stretches += 1

    def _learn_noise(self, off: Array, total: Array, noise: Array) -> None:
        s = self.state
        ratio = (np.minimum(off**2 / total, _MOST_RATIO) - 1.0) * noise / total
        by_way, by_turn = s.noise[2] * (s.way_m - _TURN_M_PER_RAD * s.turned_rad), s.noise[3] * s.turned_rad
        part = by_turn / max(by_way + by_turn, _TINY)
        share = np.array([1.0, 1.0, 1.0 - part, part])
        gain = np.maximum(_GAIN / np.sqrt(1.0 + s.taught), _LEAST_GAIN)
        step = np.exp(gain * share * ratio[[0, 1, 2, 2]])
        s.noise = np.clip(s.noise * step, _QUIETEST * _COMMISSIONED, _LOUDEST * _COMMISSIONED)
        s.taught = s.taught + share


def _carried(way: Array) -> Array:
    """(3, 3) a twist at the start of a way (3,) as one at its end."""
    x, y, turn = way.tolist()
    c, k = math.cos(turn), math.sin(turn)
    return np.array([[c, k, -c * y + k * x], [-k, c, k * y + c * x], [0.0, 0.0, 1.0]])
