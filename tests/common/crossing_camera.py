"""A camera under a simulated ceiling that sees crossings, not pictures: exact truth, with misses and mistakes added.

It is a hundred times faster than rendering. What it misses and mistakes is what was counted in rendered pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from drawn_crossings import crossings_at

from ceilvo import se2
from ceilvo.crossing_types import crossing_type_of, quarter_turns, turned_type
from ceilvo.sim.ceiling.arrangement import make_layout
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.types import Crossings, LineKind

HALF_VIEW_M = np.array([1.65, 1.2])
"""Of the simulated rig's picture on a ceiling 2.2 m high, without its rim."""
_NEAR_M = 0.03
"""By which lines are prolonged to meet: corners of lamps are not sharp."""


@dataclass(frozen=True)
class Flaws:
    """Shares of lines and crossings that are not seen, of edges that are taken for another kind, and noise."""

    lines: float = 0.01
    crossings: float = 0.01
    kinds: float = 0.03
    noise_m: float = 3e-4
    noise_rad: float = 2e-4


@dataclass(frozen=True)
class CrossingCamera:
    """Looks up from a robot anywhere below one ceiling."""

    xy_m: np.ndarray
    kind: np.ndarray  # (N, 2) of both lines
    line: np.ndarray  # (N, 2) which lines
    flaws: Flaws = field(default_factory=Flaws)

    @staticmethod
    def under(spec: CeilingSpec, seed: int, flaws: Flaws | None = None) -> CrossingCamera:
        lines = make_layout(spec, np.random.default_rng([seed, 0xCE11])).lines()
        first, second = np.flatnonzero(lines.axis == 0), np.flatnonzero(lines.axis == 1)
        x, y = lines.segments[first, 0, 0], lines.segments[second, 0, 1]
        reach = np.array([-_NEAR_M, _NEAR_M])
        y_from, y_to = (np.sort(lines.segments[first, :, 1], axis=1) + reach).T
        x_from, x_to = (np.sort(lines.segments[second, :, 0], axis=1) + reach).T
        meet = (y > y_from[:, None]) & (y < y_to[:, None]) & (x[:, None] > x_from) & (x[:, None] < x_to)
        i, j = np.nonzero(meet)
        kind = np.column_stack([lines.kind[first[i]], lines.kind[second[j]]])
        return CrossingCamera(
            np.column_stack([x[i], y[j]]), kind, np.column_stack([first[i], second[j]]), flaws or Flaws()
        )

    def sees(self, pose: np.ndarray, seed: int) -> Crossings:
        """The view from map_from_base (3,), with the axes named as the line fit names them."""
        rng, f = np.random.default_rng([seed, 0xE7E]), self.flaws
        base = se2.transform(se2.inverse(pose), self.xy_m)
        seen = np.all(np.abs(base) < HALF_VIEW_M, axis=1)
        lost = rng.random(int(self.line.max()) + 1) < f.lines
        seen &= ~np.any(lost[self.line], axis=1) & (rng.random(len(seen)) > f.crossings)
        kind = np.where(rng.random(self.kind.shape) < f.kinds, _mistaken(self.kind, rng), self.kind)[seen]
        psi = float((-pose[2] + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        turns = quarter_turns(psi + float(pose[2]), 0.0)
        xy = base[seen] + rng.normal(0.0, f.noise_m, (int(seen.sum()), 2))
        kinds = turned_type(crossing_type_of(kind[:, 0], kind[:, 1]), -turns)
        return crossings_at(xy, kinds, 1e-3, psi + float(rng.normal(0.0, f.noise_rad)), 2e-4)


def _mistaken(kind: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An edge beside a joint is taken for the joint, a joint seldom for an edge."""
    edge = rng.choice([int(LineKind.FALLING), int(LineKind.RISING)], kind.shape)
    joint = int(LineKind.GROOVE)
    return np.where(kind == joint, np.where(rng.random(kind.shape) < 0.1, edge, kind), joint)
