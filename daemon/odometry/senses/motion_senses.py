"""All senses of motion beside the eye as one stage: what they say of a frame beforehand, what they learn from it.

told() is asked before the frame is looked at and changes nothing. step() takes the frame in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.config.sections.senses import Senses
from ceilvo.daemon.odometry.coasting import KnownTurn
from ceilvo.daemon.odometry.senses.gyro import Gyro, GyroState
from ceilvo.daemon.odometry.senses.gyro_path import GyroPath, GyroPathState
from ceilvo.daemon.odometry.senses.lag import Lag, LagState
from ceilvo.daemon.odometry.senses.lifted import Lifted, LiftedState
from ceilvo.daemon.odometry.senses.reckoning import Reckoning, Step, arc
from ceilvo.daemon.odometry.senses.slip import AXES, Compared, Slip, SlipTest, SlipTestState
from ceilvo.daemon.odometry.senses.wheel_scales import PARAMETERS, WheelScales, WheelScalesState
from ceilvo.senses.heard import Turn
from ceilvo.types import Array, Displacement, Motion, WheelMotion

_UNKNOWN_LATE_S = 0.05
"""Standard deviation of a delay that is not known yet; chosen: cameras are 20 to 120 ms late."""
_EXTRAPOLATED_M, _EXTRAPOLATED_RAD = 0.001, 0.002
"""Error of the wheels' motion by what lies beyond the base's last telegram, 1 m/s^2 and 2 rad/s^2 for 45 ms."""
_STAMP_S = 0.002
"""Standard deviation of when a count was taken; as drivers/base/wheel_track.py."""
_BETWEEN_S = 0.04
"""How far beyond a sample a stamp may lie, during which the rate changes as it did; as gyro.py."""
_SURE_DOUBT = 1e-3
"""A motion that is in doubt by more teaches nothing."""
_GYRO_KNOWN = 3
"""Turns that were learnt from before a gyro is believed; chosen: its bias is known to .1 deg/s then."""
_ALL = PARAMETERS + 2
"""Parameters of wheels, and bias and scale of the gyro."""


@dataclass(frozen=True, slots=True)
class Told:
    """The motion since the last frame, as far as senses beside the eye know it.

    Attributes:
        wheels: with the scales, the noise and, where there is a gyro, the turn that are known.
        turn: by the gyro, where there are no wheels.
    """

    wheels: WheelMotion | None
    turn: KnownTurn | None = None


@dataclass(frozen=True, slots=True)
class Noticed:
    """What a frame shows.

    Attributes:
        slips: that go on.
        carried_rad: turned while the wheels stood, said until the eye measures a motion again; None where not.
        begins: that is noticed now.
        still: the gyro was there all through the gap that ends here, and told no motion.
    """

    slips: tuple[Slip, ...] = ()
    carried_rad: float | None = None
    begins: bool = False
    still: bool = False


@dataclass(slots=True)
class MotionSensesState:
    """Of each part, and of all together.

    Attributes:
        gap: the way since the last frame that the eye measured.
        twist: (3,) [m/s, m/s, rad/s] by wheels in the last frame; seen: the eye measured that.
        off_floor: since the eye last measured, the wheels have left the floor.
        watched: since then wheels and gyro told the same all the time.
        eye_twist: (3,) [m/s, m/s, rad/s] as the eye last measured it.
    """

    wheels: WheelScalesState = field(default_factory=WheelScalesState)
    gyro: GyroState = field(default_factory=GyroState)
    slip: SlipTestState = field(default_factory=SlipTestState)
    wheels_lag: LagState = field(default_factory=LagState)
    gyro_lag: LagState = field(default_factory=LagState)
    gyro_path: GyroPathState = field(default_factory=GyroPathState)
    lifted: LiftedState = field(default_factory=LiftedState)
    gap: Reckoning = field(default_factory=lambda: Reckoning.start(_ALL))
    twist: Array = field(default_factory=lambda: np.zeros(3))
    seen: bool = False
    off_floor: bool = False
    watched: bool = True
    eye_twist: Array = field(default_factory=lambda: np.zeros(3))


class MotionSenses:
    """Of one robot; what is not switched on does nothing."""

    def __init__(self, config: Senses) -> None:
        self._config = config
        self.wheels, self.gyro, self.slip, self.lifted = WheelScales(config), Gyro(config), SlipTest(), Lifted()
        self.wheels_lag, self.gyro_lag, self.gyro_path = Lag(), Lag(), GyroPath()
        self._gap, self._twist, self._seen = Reckoning.start(_ALL), np.zeros(3), False
        self._off_floor, self._watched, self._eye_twist = False, True, np.zeros(3)
        self._walk = np.append(np.zeros(PARAMETERS), [self.gyro.walk, 0.0])

    @property
    def on(self) -> bool:
        return self._config.wheels or self._config.gyro != "none"

    @property
    def state(self) -> MotionSensesState:
        """All that is remembered; setting it continues from there."""
        return MotionSensesState(
            self.wheels.state,
            self.gyro.state,
            self.slip.state,
            self.wheels_lag.state,
            self.gyro_lag.state,
            self.gyro_path.state,
            self.lifted.state,
            self._gap,
            self._twist,
            self._seen,
            self._off_floor,
            self._watched,
            self._eye_twist,
        )

    @state.setter
    def state(self, s: MotionSensesState) -> None:
        self.wheels.state, self.gyro.state, self.slip.state, self.lifted.state = s.wheels, s.gyro, s.slip, s.lifted
        self.wheels_lag.state, self.gyro_lag.state, self.gyro_path.state = s.wheels_lag, s.gyro_lag, s.gyro_path
        self._gap, self._twist, self._seen = s.gap, s.twist, s.seen
        self._off_floor, self._watched, self._eye_twist = s.off_floor, s.watched, s.eye_twist

    @property
    def wheels_late(self) -> tuple[float, float]:
        """By how much the eye is later than the wheels, s, and its standard deviation; 0 and inf while not known."""
        return self._one_base() if self._config.gyro == "base" else (self.wheels_lag.known_s, self.wheels_lag.sigma_s)

    @property
    def gyro_late(self) -> tuple[float, float]:
        """The same for the gyro."""
        return self._one_base() if self._config.gyro == "base" else (self.gyro_lag.known_s, self.gyro_lag.sigma_s)

    def _one_base(self) -> tuple[float, float]:
        """Both come in the same telegrams, so both tell one delay."""
        lags = [lag for lag in (self.wheels_lag, self.gyro_lag) if math.isfinite(lag.sigma_s)]
        if not lags:
            return 0.0, math.inf
        weight = [lag.sigma_s**-2 for lag in lags]
        known_s = sum(w * lag.known_s for w, lag in zip(weight, lags, strict=True)) / sum(weight)
        return known_s, sum(weight) ** -0.5

    def restart(self) -> None:
        """After a reset: what was learnt of the robot stays."""
        self.wheels.leave()
        self.wheels_lag.restart()
        self.gyro_lag.restart()
        self.slip.state = SlipTestState(began=self.slip.state.began)
        self.gyro_path.state, self.lifted.state = GyroPathState(), LiftedState()
        self._gap, self._seen = Reckoning.start(_ALL), False
        self._off_floor, self._watched = False, True

    # -- before the view

    def told(self, wheels: WheelMotion | None, turn: Turn | None, elapsed_s: float) -> Told:
        """What is known of the motion since the last frame.

        Args:
            wheels: between the moments that both pictures show.
            turn: between the stamps; the eye's delay is taken out here.
        """
        if not self.on or elapsed_s <= 0.0:
            return Told(wheels)
        heard = self._between_pictures(turn, elapsed_s)
        wheels = None if self._off_floor else wheels
        step = self._step(wheels, heard, elapsed_s)
        if step is None:
            return Told(None)
        after, moved = self._gap.then(step, elapsed_s, self._walk), arc(step.twist)[0]
        cov = after.share_of(self._gap, self._parameters(), moved)
        if wheels is None:
            return Told(None, KnownTurn(float(moved[2]), float(cov[2, 2])))
        return Told(WheelMotion(Displacement(moved), cov, self._watched and self._believes(heard)))

    def since(self, wheels: WheelMotion | None, late_s: float) -> WheelMotion | None:
        """What the robot did in the last late_s, until the stamp of the last frame; None where nothing tells.

        Args:
            wheels: in that time, as they report it.
        """
        heard = self.gyro_path.last(late_s) if self.on and self._config.gyro != "none" else None
        step = self._step(None if self._off_floor else wheels, heard, late_s) if self.on else None
        if step is None:
            return wheels
        twist = step.twist if wheels is not None else np.append(self._eye_twist[:2] * late_s, step.twist[2])
        moved, bend = arc(twist)
        return WheelMotion(Displacement(moved), bend @ step.noise @ bend.T)

    def _between_pictures(self, turn: Turn | None, elapsed_s: float) -> Turn | None:
        if turn is None or self._config.gyro == "none":
            return None
        return self.gyro_path.earlier(turn, self.gyro_late[0], elapsed_s)

    def _step(self, wheels: WheelMotion | None, turn: Turn | None, elapsed_s: float) -> Step | None:
        """By wheels, with the gyro's turn where it is believed; by the gyro alone; None where neither says anything."""
        by_gyro = turn if self._believes(turn) else None
        if wheels is None and by_gyro is None:
            return None
        twist, by, noise = np.zeros(3), np.zeros((3, _ALL)), np.zeros((3, 3))
        if wheels is not None:
            step = self._by_wheels(wheels)
            twist, noise = step.twist.copy(), step.noise.copy()
            by[:, :PARAMETERS] = step.by_parameters
        if by_gyro is not None:
            twist[2] = self.gyro.turned_rad(by_gyro)
            noise[2, :] = noise[:, 2] = 0.0
            noise[2, 2], by[2, :] = by_gyro.var_rad2, 0.0
            by[2, PARAMETERS:] = self.gyro.by_parameters(by_gyro)
        if not self._gap.seconds:
            noise = noise + np.diag(self._gap_ends(twist / elapsed_s, by_gyro))
        return Step(twist, by, noise)

    def _gap_ends(self, rate: Array, by_gyro: Turn | None) -> Array:
        """(3,) variance of a gap's way by where its start lies between samples, at a twist (3,) a second: what was told
        beyond a sample is off by as much as the twist has changed since. (Its end shifts the newest pose only.)"""
        change = rate - self._twist
        if by_gyro is not None:
            change[2] = by_gyro.turned_rad / by_gyro.span_s - self.gyro.state.rate_radps
        var = (_STAMP_S * rate) ** 2 + (_BETWEEN_S * change) ** 2
        return np.minimum(var, _ends(rate, by_gyro))

    def _believes(self, turn: Turn | None) -> bool:
        """Whether the gyro says something, and enough is known of it."""
        return turn is not None and self.gyro.state.updates >= _GYRO_KNOWN

    def _by_wheels(self, wheels: WheelMotion) -> Step:
        if self._config.wheels:
            return self.wheels.step(wheels)
        return Step(se2.mean_twist(wheels.prev_from_curr, 1.0), np.zeros((3, PARAMETERS)), wheels.cov)

    def _parameters(self) -> Array:
        cov = np.zeros((_ALL, _ALL))
        cov[:PARAMETERS, :PARAMETERS] = self.wheels.state.cov
        cov[PARAMETERS:, PARAMETERS:] = self.gyro.cov_then
        return cov

    # -- after it

    def step(self, motion: Motion, wheels: WheelMotion | None, turn: Turn | None, elapsed_s: float) -> Noticed:
        """Take a frame in: what the eye made of it, and what told() was told."""
        if not self.on or elapsed_s <= 0.0:
            return Noticed()
        heard = self._between_pictures(turn, elapsed_s)
        step = self._step(None if self._off_floor else wheels, heard, elapsed_s)
        seen = motion.ok and not motion.restarted
        usable = seen and self._seen and motion.doubt < _SURE_DOUBT
        by_wheels = None if wheels is None else self._by_wheels(wheels)
        slips = self._slips(motion, by_wheels, heard, usable, elapsed_s)
        carried_rad, still = self._lifted(motion, wheels, heard, seen, elapsed_s)
        self._learn(motion, by_wheels, heard, usable, elapsed_s)
        if self._config.gyro != "none":
            self._follow(motion, turn, seen, elapsed_s)
        ended = motion.ok or motion.restarted
        off_floor, before = self._off_floor or carried_rad is not None, self._off_floor
        self._off_floor = off_floor and not ended
        unlike = any(s.axis == AXES[2] for s in slips) or off_floor
        self._watched = self._believes(heard) and not unlike and (ended or self._watched)
        if usable:
            self._eye_twist = se2.mean_twist(motion.prev_from_curr, elapsed_s)
        if slips:
            self.wheels_lag.skip(self.slip.state.time_s)
        self._gap = Reckoning.start(_ALL) if ended or step is None else self._gap.then(step, elapsed_s, self._walk)
        self._twist = np.zeros(3) if by_wheels is None else by_wheels.twist / elapsed_s
        self._seen = ended
        carried_rad = self.lifted.state.turned_rad if off_floor else None
        return Noticed(tuple(slips), carried_rad, off_floor and not before, still)

    def _slips(
        self, motion: Motion, by_wheels: Step | None, turn: Turn | None, usable: bool, elapsed_s: float
    ) -> list[Slip]:
        by_gyro = turn if self._believes(turn) else None
        if not self._config.wheels or by_wheels is None or not (usable or by_gyro is not None):
            self.slip.miss(elapsed_s)
            return []
        counted, p = by_wheels.twist, self.wheels.state.cov
        scale = np.sqrt(np.maximum(np.diagonal(by_wheels.by_parameters @ p @ by_wheels.by_parameters.T), 0.0))
        rate = counted / elapsed_s
        ends = _ends(rate, None)
        moved, known, var = counted.copy(), np.zeros(3), np.diagonal(by_wheels.noise).copy()
        if usable:
            moved, known = se2.mean_twist(motion.prev_from_curr, 1.0), np.ones(3)
            ends = ends + np.diagonal(motion.cov)
        elif by_gyro is not None:
            moved[2], known[2] = self.gyro.turned_rad(by_gyro), 1.0
            var[2] += by_gyro.var_rad2
            scale[2] += math.sqrt(max(self.gyro.var_rad2(by_gyro) - by_gyro.var_rad2, 0.0))
            ends[2] += by_gyro.ends_rad2
        late = (rate - self._twist) * min(self.wheels_late[1], _UNKNOWN_LATE_S)
        return self.slip.step(Compared(counted, moved, known, var, scale, late, ends), elapsed_s)

    def _lifted(
        self, motion: Motion, wheels: WheelMotion | None, turn: Turn | None, seen: bool, elapsed_s: float
    ) -> tuple[float | None, bool]:
        """By how much it was turned while its wheels stood, and whether it stood all through a gap that ends here."""
        if wheels is None or turn is None:
            self.lifted.miss()
            return None, False
        return self.lifted.step(wheels, turn, self.gyro, seen, elapsed_s)

    def _learn(self, motion: Motion, by_wheels: Step | None, turn: Turn | None, usable: bool, elapsed_s: float) -> None:
        self.gyro.passed(elapsed_s)
        if turn is not None and usable:
            late_sigma_s = min(self.gyro_late[1], _UNKNOWN_LATE_S)
            self.gyro.learn(turn, float(motion.prev_from_curr[2]), float(motion.cov[2, 2]), late_sigma_s)
        else:
            self.gyro.leave()
            if turn is not None and self.lifted.stands and not motion.ok:
                self.gyro.learn_standing(turn)
        if not self._config.wheels or by_wheels is None:
            return
        if not usable or any(self.slip.slipping):
            self.wheels.leave()
            return
        late_sigma_s = min(self.wheels_late[1], _UNKNOWN_LATE_S)
        self.wheels.learn(by_wheels, motion.prev_from_curr, motion.cov, elapsed_s, late_sigma_s)

    def _follow(self, motion: Motion, turn: Turn | None, seen: bool, elapsed_s: float) -> None:
        """The delay of the gyro; where it is the wheels' too, each begins anew when the other has jumped."""
        self.gyro_path.add(motion, turn, seen, elapsed_s)
        if self._config.time and len(self.gyro_path):
            self.gyro_lag.step(self.gyro_path.series())
        if self._config.time and self._config.gyro == "base":
            for one, other in ((self.wheels_lag, self.gyro_lag), (self.gyro_lag, self.wheels_lag)):
                if one.state.jumped_now and one.state.delay_s is not None:
                    other.begin_anew(one.state.delay_s)
                one.state.jumped_now = False


def _ends(rate: Array, by_gyro: Turn | None) -> Array:
    """(3,) variance of a way, however long, at a twist (3,) [m/s, m/s, rad/s], by where its ends lie in time."""
    var = 2.0 * (_STAMP_S * rate) ** 2 + np.array([_EXTRAPOLATED_M, _EXTRAPOLATED_M, _EXTRAPOLATED_RAD]) ** 2
    if by_gyro is not None:
        var[2] = by_gyro.ends_rad2
    return np.asarray(var)
