"""One condition of the vision bench, and the bars that hold for each of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from ceilvo.calibration import Calibration
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapPath, LapSpec, TiltSpec
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.rig import simulated_calibration
from ceilvo.sim.surroundings.surroundings import SurroundingsSpec
from ceilvo.sim.world import World, WorldSpec

LAP = LapSpec(room_m=6.94, inset_m=1.0)  # 19.0 m
USUAL = RenderSpec()


@dataclass(frozen=True)
class Bar:
    """A figure's bound: at least (">=") or at most ("<=") `value`."""

    sense: Literal["<=", ">="]
    value: float

    def met(self, figure: float) -> bool:
        """False for nan."""
        return figure >= self.value if self.sense == ">=" else figure <= self.value


@dataclass(frozen=True)
class Condition:
    """One run of the bench.

    Attributes:
        assumed: the calibration given to the pipeline; None is the true one.
        blackouts_s: starts of one second without light each, as shares of the run.
        overrides: `section.key=value` each, on top of the default configuration.
        known: the robot starts again on the map, with the heights, of an earlier run of the same.
        bars: figure name to its bar; the names are those that run() gives.
    """

    name: str
    about: str
    spec: WorldSpec = field(default_factory=lambda: WorldSpec(lap=LAP))
    true: Calibration = field(default_factory=simulated_calibration)
    assumed: Calibration | None = None
    fps: float = 30.0
    blackouts_s: tuple[float, ...] = ()
    overrides: tuple[str, ...] = ()
    known: bool = False
    bars: dict[str, Bar] = field(default_factory=dict)

    @property
    def lap_s(self) -> float:
        """World time at the end of the first lap."""
        lap = self.spec.lap
        return LapPath(lap).lap_m / lap.speed_mps + lap.rest_s + 0.5 * lap.ramp_s

    def with_seed(self, seed: int) -> Condition:
        """The same in another world: its ceiling, noise and rocking are drawn anew."""
        return replace(self, spec=replace(self.spec, seed=seed))

    def world(self) -> World:
        return World(self.spec, self.true)

    @property
    def calibration(self) -> Calibration:
        return self.assumed or self.true


def at_least(value: float) -> Bar:
    return Bar(">=", value)


def at_most(value: float) -> Bar:
    return Bar("<=", value)


ALWAYS = {
    "heading_deg": at_most(0.1),
    "tracking_worst_mm": at_most(50.0),
    "wrong_pose_s": at_most(0.0),
    "beyond_3_sigma_pct": at_most(0.3),
    "gap_nees": at_most(2.0),
}
"""Of every condition (docs/bench.md). Of normal errors that are as large as claimed .27 % are beyond three standard
deviations; that, rounded."""


def make(
    name: str,
    about: str,
    *,
    render: RenderSpec = USUAL,
    ceiling: CeilingSpec | None = None,
    lap: LapSpec = LAP,
    tilt: TiltSpec | None = None,
    surroundings: SurroundingsSpec | None = None,
    true: Calibration | None = None,
    assumed: Calibration | None = None,
    fps: float = 30.0,
    blackouts: tuple[float, ...] = (),
    overrides: tuple[str, ...] = (),
    bars: dict[str, Bar] | None = None,
) -> Condition:
    """A condition that differs from the usual room, light, robot and camera in what is said, held to ALWAYS as well."""
    spec = WorldSpec(
        lap=lap,
        ceiling=ceiling or CeilingSpec(),
        render=render,
        tilt=tilt or TiltSpec(),
        surroundings=surroundings or SurroundingsSpec(),
    )
    return Condition(
        name=name,
        about=about,
        spec=spec,
        true=true or simulated_calibration(),
        assumed=assumed,
        fps=fps,
        blackouts_s=blackouts,
        overrides=overrides,
        bars={**(bars or {}), **ALWAYS},
    )
