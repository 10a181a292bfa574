"""A gyro's bias and scale, learnt from the ceiling's direction and while the robot stands.

State: bias rad/s and by which share it counts too much, as one Gaussian. What it says of an interval g is
(1 + scale) * turned + bias * time, with white noise; the bias drifts.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.config.sections.senses import Senses
from ceilvo.senses.heard import Turn
from ceilvo.types import Array

_GATE_SIGMAS = 5.0
"""Of a turn that eye and gyro tell apart, beyond which one of them is wrong; noise alone is once in 10^6."""
_STILL_GATE_SIGMAS = 3.0
"""The same while only the wheels say that the robot stands; chosen: one that is carried turns by more."""
_EYE_RAD = 1e-4
"""Of the eye's turn besides what it says; chosen: lines that are not quite straight, docs/method.md."""
_STRETCH_S, _LONGEST_S = 0.5, 4.0
"""Eye and gyro are compared over so long, and on until the robot hardly turns: at the ends of an interval the gyro's
angle lies between samples; chosen."""
_SLOW_RADPS = 0.1
"""Hardly turning."""
_BETWEEN_S, _STAMP_S = 0.04, 0.002
"""How far beyond a sample an end may lie, during which the rate changes as it did; error of a sample's time."""


@dataclass(slots=True)
class GyroState:
    """
    Attributes:
        bias_scale: (2,) bias rad/s and share by which it counts too much; cov: (2, 2), None before the first turn.
        drifted: (rad/s)^2 of cov by which the bias has drifted since it was learnt from.
        updates: learnt from; refused: beyond the gate.
        turned_rad, seen_rad, var_rad2, span_s: by gyro, by eye and the gyro's noise since the stretch under way began.
        ends_rad2: variance of by how much the angle was too far at its start; start_rad: what the stretch before, which
            ended there, tells of that; start_with: (2,) covariances of it with bias and scale.
        rate_radps: of the last frame.
    """

    bias_scale: Array = field(default_factory=lambda: np.zeros(2))
    cov: Array | None = None
    drifted: float = 0.0
    updates: int = 0
    refused: int = 0
    turned_rad: float = 0.0
    seen_rad: float = 0.0
    var_rad2: float = 0.0
    span_s: float = 0.0
    ends_rad2: float = 0.0
    start_rad: float = 0.0
    start_with: Array = field(default_factory=lambda: np.zeros(2))
    rate_radps: float = 0.0


class Gyro:
    """Of one robot.

    Attributes:
        walk: (rad/s)^2 by which the bias drifts in a second.
    """

    def __init__(self, config: Senses) -> None:
        self._prior = np.diag([np.radians(config.gyro_bias_dps) ** 2, config.gyro_scale_sigma**2])
        self.walk = float(np.radians(config.gyro_walk_dps)) ** 2
        self.state = GyroState()

    @property
    def cov(self) -> Array:
        """(2, 2) of bias and scale."""
        return self._prior if self.state.cov is None else self.state.cov

    @property
    def cov_then(self) -> Array:
        """(2, 2) when it was last learnt from; what the bias has drifted by since errs from then on only."""
        return self.cov - np.diag([self.state.drifted, 0.0])

    def passed(self, seconds: float) -> None:
        """The bias drifts with time."""
        s, most = self.state, float(self._prior[0, 0])
        before = self.cov
        s.cov = before + np.diag([min(self.walk * seconds, max(most - float(before[0, 0]), 0.0)), 0.0])
        s.drifted += float(s.cov[0, 0] - before[0, 0])

    def turned_rad(self, turn: Turn) -> float:
        """What the robot turned, by what is known of the gyro."""
        bias, scale = self.state.bias_scale.tolist()
        return float((turn.turned_rad - bias * turn.span_s) / (1.0 + scale))

    def by_parameters(self, turn: Turn) -> Array:
        """(2,) derivative of turned_rad() by bias and scale."""
        one = 1.0 + float(self.state.bias_scale[1])
        return np.array([-turn.span_s / one, -self.turned_rad(turn) / one])

    def var_rad2(self, turn: Turn) -> float:
        """Variance of turned_rad(), with that of bias and scale."""
        by = self.by_parameters(turn)
        return float(by @ self.cov @ by) + turn.var_rad2

    def leave(self) -> None:
        """The stretch under way tells nothing: the eye saw nothing."""
        self._forget_start()
        self._begin()

    def _forget_start(self) -> None:
        s = self.state
        s.ends_rad2, s.start_rad, s.start_with = 0.0, 0.0, np.zeros(2)

    def _begin(self) -> None:
        s = self.state
        s.turned_rad = s.seen_rad = s.var_rad2 = s.span_s = 0.0

    def learn(self, turn: Turn, seen_rad: float, seen_var_rad2: float, late_sigma_s: float) -> None:
        """The same interval by eye; late_sigma_s: how well the delay between them is known."""
        s = self.state
        rate = turn.turned_rad / turn.span_s
        change = rate - s.rate_radps
        end = (change * _BETWEEN_S) ** 2 + (_STAMP_S * rate) ** 2 + (late_sigma_s * rate) ** 2
        s.rate_radps = rate
        if not s.ends_rad2:
            s.ends_rad2 = end
        s.turned_rad, s.seen_rad = s.turned_rad + turn.turned_rad, s.seen_rad + seen_rad
        s.var_rad2, s.span_s = s.var_rad2 + turn.var_rad2, s.span_s + turn.span_s
        if s.span_s < _STRETCH_S or (abs(rate) > _SLOW_RADPS and s.span_s < _LONGEST_S):
            return
        var = s.var_rad2 + seen_var_rad2 + _EYE_RAD**2
        self._update(s.turned_rad, s.seen_rad, s.span_s, var, _GATE_SIGMAS, end)
        self._begin()

    def learn_standing(self, turn: Turn) -> None:
        """The robot stands, by its wheels."""
        self._update(turn.turned_rad, 0.0, turn.span_s, turn.var_rad2 + _EYE_RAD**2, _STILL_GATE_SIGMAS)

    def _update(
        self, turned_rad: float, seen_rad: float, span_s: float, var_rad2: float, gate: float, end_rad2: float = 0.0
    ) -> None:
        """A stretch. What it has too much at its end the next one lacks, so that is estimated until then, beside bias
        and scale."""
        s = self.state
        cov = np.diag([0.0, 0.0, 0.0, end_rad2])
        cov[:2, :2] = self.cov
        cov[2, :2] = cov[:2, 2] = s.start_with
        cov[2, 2] = s.ends_rad2
        h = np.array([span_s, seen_rad, -1.0, 1.0])
        off = turned_rad - seen_rad * (1.0 + float(s.bias_scale[1])) - float(s.bias_scale[0]) * span_s + s.start_rad
        total = float(h @ cov @ h) + var_rad2
        if off**2 > gate**2 * total:
            s.refused += 1
            self._forget_start()
            return
        gain = cov @ h / total
        cov = cov - np.outer(gain, h @ cov)
        s.bias_scale, s.cov, s.drifted = s.bias_scale + gain[:2] * off, cov[:2, :2].copy(), 0.0
        s.ends_rad2, s.start_rad, s.start_with = float(cov[3, 3]), float(gain[3]) * off, cov[3, :2].copy()
        s.updates += 1
