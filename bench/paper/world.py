"""The paper's section 3 as a simulated world: a 5 m room, a lap along its walls, noise that grows with distance.

Everything random is drawn from the seed, before any filter sees it: all filters of one seed get the same recording.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceilvo.se2 import compose, inverse, transform, wrap_array
from ceilvo.types import Array, Displacement, Ints, Motion

ROOM_M = 5.0  # side; the paper, section 3
INSET_M = 0.45
"""Distance of the lap from the walls."""
LAP_STEPS = 225  # docs/experiments.md; the paper says only that the robot runs around along the walls
SPEED_M_S = 0.35  # docs/experiments.md; not in the paper
DT_S = 0.2  # docs/experiments.md; not in the paper
VIEW_M = 1.6  # features farther away are not seen; docs/experiments.md, not in the paper
FEATURE_MARGIN_M = 0.8  # from the walls; chosen, the paper does not say where features lie
FEATURE_JITTER_M = 0.3  # either way, uniform; chosen, likewise: features do not lie on a grid
TILE_M = 0.6  # docs/experiments.md: the usual tile of an office ceiling
LAMP_FRACTION, VENT_FRACTION = 0.12, 0.05
"""Of the tiles; chosen: few of each, so that most of a view is plain crossings."""
KIND_CROSSING, KIND_LAMP, KIND_VENT = 0, 1, 2  # codes of this bench
KIDNAP_M = 0.4  # docs/experiments.md: more than half a tile, less than one


@dataclass(frozen=True)
class Setting:
    """Noise of the world, and what the filters are reported of it.

    Attributes:
        forward_m_per_m, lateral_m_per_m, heading_rad_per_m: standard deviation of a step's odometry per metre of it.
        slip_per_m: chance per metre that the wheels begin to slip; for slip_steps steps the robot then moves by
            (1 - slip_share) of the way that the wheels say (negative: it runs on farther than they say).
        stalls: the wheels keep their speed and the robot falls behind; else the robot keeps its speed.
        slip_turn_rad_per_m: while slipping the robot turns by this much more per metre than the wheels say, each time
            to a side that is drawn.
        outlier_share, outlier_m: observations shifted by outlier_m in a random direction.
        sigma0_m, sigma2_per_m: sigma(r) = sigma0 + sigma2 r^2, along x and y alike.
        sigma_theta_rad: of the heading observation (R33 of eq. 27); infinite = no heading is measured.
        features_per_side: of the room, squared; the paper has 16.
        assumed: the filters assume all standard deviations this many times larger.
    """

    name: str
    forward_m_per_m: float = 0.10
    lateral_m_per_m: float = 0.06
    heading_rad_per_m: float = 0.10
    slip_per_m: float = 0.08
    slip_share: float = 0.4
    slip_steps: int = 4
    stalls: bool = False
    slip_turn_rad_per_m: float = 0.0
    outlier_share: float = 0.02
    outlier_m: float = 0.6
    sigma0_m: float = 0.04
    sigma2_per_m: float = 0.045
    sigma_theta_rad: float = 0.035
    features_per_side: int = 4
    assumed: float = 1.2

    def sigma(self, r_m: Array) -> Array:
        """sigma_x = sigma_y at distances r (eq. 26)."""
        return np.asarray(self.sigma0_m + self.sigma2_per_m * r_m**2, np.float64)


P = Setting("P")
SETTINGS = {
    "P": P,
    "S0": replace(P, name="S0", slip_per_m=0.0, outlier_share=0.0, assumed=1.0),
    "S1": replace(P, name="S1", slip_per_m=0.30, outlier_share=0.03),
    "Y": replace(P, name="Y", slip_per_m=0.15, slip_share=0.0, slip_turn_rad_per_m=1.0),
    "YN": replace(P, name="YN", slip_per_m=0.15, slip_share=0.0, slip_turn_rad_per_m=1.0, sigma_theta_rad=np.inf),
    "O": replace(P, name="O", slip_per_m=0.15, slip_share=-0.6),
    "L": replace(P, name="L", slip_share=0.9, slip_steps=20, stalls=True),
    "F": replace(P, name="F", features_per_side=2),
}
"""The settings of docs/experiments.md; S1's slip rate was set by looking at `pf` and `ukf_gated` alone, those of Y, YN
and O are chosen: two a lap. L loses 90 % of 1.4 m."""


@dataclass(frozen=True)
class Scene:
    """Landmarks of a room: xy (L, 2) m, kind (L,). Where kinds are identities, association is known."""

    xy_m: Array
    kind: Ints


@dataclass(frozen=True)
class Step:
    """One step of a recording: what happened, and what the filter is reported."""

    truth: Array
    reported: Array
    reported_cov: Array
    seen: Ints
    xy_base_m: Array
    sigma_m: Array
    heading_rad: float
    heading_sigma_rad: float

    @property
    def motion(self) -> Motion:
        """What the wheels report of it."""
        return Motion(Displacement(self.reported), self.reported_cov, len(self.seen), 0.0, by_wheels=True)


@dataclass(frozen=True)
class Recording:
    """start (3,) and steps; kidnapped is the step before which the robot was carried away, or -1."""

    scene: Scene
    start: Array
    steps: tuple[Step, ...]
    kidnapped: int = -1


def lap_steps() -> Array:
    """(225, 3) displacements of a lap, counter-clockwise: a square with rounded corners, 0.35 m/s, dt 0.2 s."""
    return np.array([lap_step(i) for i in range(LAP_STEPS)])


def lap_step(done: float, portion: float = 1.0) -> Array:
    """(3,) displacement by a portion of a step, so many steps after the start."""
    here, there = (_on_lap(x % LAP_STEPS * SPEED_M_S * DT_S, *_lap_shape()) for x in (done, done + portion))
    return np.asarray(compose(inverse(here), there), np.float64)


def lap_start() -> Array:
    return np.array([INSET_M + _lap_shape()[1], INSET_M, 0.0])


def _lap_shape() -> tuple[float, float]:
    """Length of a side and radius of the corners, m."""
    side = ROOM_M - 2 * INSET_M
    return side, (4 * side - LAP_STEPS * SPEED_M_S * DT_S) / (8 - 2 * np.pi)


def _on_lap(s: float, side: float, radius: float) -> Array:
    """Pose after s metres, in the room."""
    straight, arc = side - 2 * radius, 0.5 * np.pi * radius
    quarter, rest = divmod(s, straight + arc)
    turn = max(rest - straight, 0.0) / radius
    x = min(rest, straight) + radius * np.sin(turn)
    corner = np.array([x - 0.5 * straight, radius * (1.0 - np.cos(turn)) - 0.5 * side, turn])
    a = 0.5 * np.pi * quarter
    turned = compose(np.array([0.0, 0.0, a]), corner)
    return np.asarray(turned + np.array([0.5 * ROOM_M, 0.5 * ROOM_M, 0.0]), np.float64)


def room_scene(rng: np.random.Generator, features_per_side: int = 4) -> Scene:
    """Features (16) spread over the room; their kind is their identity."""
    g = np.linspace(FEATURE_MARGIN_M, ROOM_M - FEATURE_MARGIN_M, features_per_side)
    xy = np.stack(np.meshgrid(g, g), axis=-1).reshape(-1, 2)
    xy = xy + rng.uniform(-FEATURE_JITTER_M, FEATURE_JITTER_M, xy.shape)
    return Scene(xy, np.arange(len(xy), dtype=np.int64))


def grid_scene(rng: np.random.Generator, with_kinds: bool) -> Scene:
    """Crossings of 0.6 m tiles, all of one kind; with_kinds adds lamps and vents in the middle of some tiles."""
    offset = rng.uniform(0.0, TILE_M, 2)
    g = TILE_M * np.arange(-3, int(ROOM_M / TILE_M) + 3)
    crossings = np.stack(np.meshgrid(g, g), axis=-1).reshape(-1, 2) + offset
    kind = np.full(len(crossings), KIND_CROSSING)
    if not with_kinds:
        return Scene(crossings, kind.astype(np.int64))
    draw = rng.random(len(crossings))
    lamps, vents = draw < LAMP_FRACTION, (draw >= LAMP_FRACTION) & (draw < LAMP_FRACTION + VENT_FRACTION)
    middle = crossings + 0.5 * TILE_M
    kinds = np.concatenate([kind, np.full(lamps.sum(), KIND_LAMP), np.full(vents.sum(), KIND_VENT)])
    return Scene(np.concatenate([crossings, middle[lamps], middle[vents]]), kinds.astype(np.int64))


def record(
    setting: Setting,
    scene: Scene,
    rng: np.random.Generator,
    steps: int = LAP_STEPS,
    first: int = 0,
    kidnapped: int = -1,
) -> Recording:
    """Drive `steps` steps of laps, beginning `first` steps into the lap.

    Before step `kidnapped` the robot is carried 0.4 m in a random direction, without odometry.
    """
    truth, done = lap_start(), 0.0
    for i in range(first):
        truth, done = compose(truth, lap_step(i)), done + 1.0
    start, slipping, side, out = truth, 0, 1.0, []
    for i in range(steps):
        if i == kidnapped:
            a = rng.uniform(0.0, 2.0 * np.pi)
            truth = truth + KIDNAP_M * np.array([np.cos(a), np.sin(a), 0.0])
        length = float(np.hypot(*lap_step(done)[:2]))
        if not slipping and rng.random() < setting.slip_per_m * length:
            slipping = setting.slip_steps
            side = float(np.sign(rng.random() - 0.5)) if setting.slip_turn_rad_per_m else side
        kept = 1.0 - setting.slip_share if slipping else 1.0
        portion = kept if setting.stalls else 1.0
        step = lap_step(done, portion)
        reported = step / [kept, kept, 1.0]
        reported[2] -= side * setting.slip_turn_rad_per_m * length * (slipping > 0)
        slipping = max(slipping - 1, 0)
        truth, done = compose(truth, step), done + portion
        out.append(_sense(setting, scene, truth, reported, length, rng))
    return Recording(scene, start, tuple(out), kidnapped)


def _sense(
    setting: Setting, scene: Scene, truth: Array, reported: Array, length_m: float, rng: np.random.Generator
) -> Step:
    odometry = length_m * np.array([setting.forward_m_per_m, setting.lateral_m_per_m, setting.heading_rad_per_m])
    at = transform(inverse(truth), scene.xy_m)
    seen = np.flatnonzero(np.hypot(*at.T) < VIEW_M)
    noise = setting.sigma(np.hypot(*at[seen].T))
    xy = at[seen] + noise[:, None] * rng.standard_normal((len(seen), 2))
    wrong, a = rng.random(len(seen)) < setting.outlier_share, rng.uniform(0.0, 2.0 * np.pi, len(seen))
    xy[wrong] += setting.outlier_m * np.column_stack([np.cos(a), np.sin(a)])[wrong]
    heading = np.full(1, np.nan)
    if np.isfinite(setting.sigma_theta_rad):
        heading = wrap_array(truth[2] + setting.sigma_theta_rad * rng.standard_normal(1))
    return Step(
        truth,
        reported + odometry * rng.standard_normal(3),
        np.diag((setting.assumed * odometry) ** 2),
        seen.astype(np.int64),
        xy,
        setting.assumed * setting.sigma(np.hypot(*xy.T)),  # r as the robot measures it
        float(heading[0]),
        setting.assumed * setting.sigma_theta_rad,
    )
