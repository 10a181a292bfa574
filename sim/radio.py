"""Distances that radio modules measure, wrong in the ways in which real ones are.

- Noise of a decimetre (Decawave's data sheet of the DWM1001 promises 10 cm; measured ones have 3 to 10).
- A bias that depends on distance: the receiver's stamp depends on the signal's strength. Decawave's application note
  APS011 has some -10 cm nearby and +8 cm at 40 m; here a curve through that, a little different for every anchor.
- An offset of every anchor: its antenna's delay is calibrated to some centimetres.
- Obstructed paths, 0.2 to 2 m too long, for as long as a shelf or a pillar is between (issue 18). Which anchor is
  hidden depends on the place, so that standing does not average it out.
- Ranges that fail, and anchors that are out of reach.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.senses.beacons import Anchor, Range
from ceilvo.types import Array

_NEAR_M, _BIAS_PER_DECADE_M, _BIAS_M = 8.0, 0.1, (-0.11, 0.085)
"""Where the bias is nothing, by how much it grows with the logarithm of the distance, and its ends (APS011)."""
_CELL_M = 2.0
"""An anchor is hidden or not over so much of the floor; chosen: a shelf's shadow."""


@dataclass(frozen=True)
class RadioSpec:
    """
    Attributes:
        noise_m: standard deviation of a direct range.
        offset_m: the same of an anchor's offset; curve: of each anchor's share of the bias with distance, around 1.
        obstructed: share of the floor where an anchor is hidden; longer_m: by how much its paths are longer, from, to.
        lost: share of ranges that fail; reach_m: of a module.
        rate_hz: at which each anchor is heard.
    """

    noise_m: float = 0.1
    offset_m: float = 0.05
    curve: float = 0.3
    obstructed: float = 0.15
    longer_m: tuple[float, float] = (0.2, 2.0)
    lost: float = 0.05
    reach_m: float = 60.0
    rate_hz: float = 10.0


class Radio:
    """The module on one robot, among anchors that are where they are."""

    def __init__(self, anchors: tuple[Anchor, ...], spec: RadioSpec, rng: np.random.Generator) -> None:
        self._anchors, self._spec, self._rng = anchors, spec, rng
        self._offset_m = spec.offset_m * rng.standard_normal(len(anchors))
        self._curve = 1.0 + spec.curve * rng.standard_normal(len(anchors))
        self._seed = int(rng.integers(2**31))

    def ranges(self, stamp_ns: int, tag_m: Array) -> tuple[Range, ...]:
        """One round of all anchors, the tag at (3,): x and y in map, z above the floor."""
        out = []
        for k, a in enumerate(self._anchors):
            distance = float(np.linalg.norm(tag_m - [a.x_m, a.y_m, a.z_m]))
            noise, chance = self._rng.standard_normal(), self._rng.random()
            if distance > self._spec.reach_m or chance < self._spec.lost:
                continue
            said = distance + self.bias(k, distance) + self._longer(k, tag_m) + self._spec.noise_m * noise
            out.append(Range(a.name, stamp_ns, max(float(said), 0.0)))
        return tuple(out)

    def bias(self, k: int, distance_m: float) -> float:
        """What a direct range of anchor k reads too much."""
        curve = _BIAS_PER_DECADE_M * np.log10(max(distance_m, 0.1) / _NEAR_M)
        return float(self._offset_m[k] + self._curve[k] * np.clip(curve, *_BIAS_M))

    def _longer(self, k: int, tag_m: Array) -> float:
        """What an obstructed path is longer, by the cell of the floor."""
        cell = np.floor(tag_m[:2] / _CELL_M).astype(np.int64) + 2**20
        draw = np.random.default_rng([self._seed, k, *cell.tolist()])
        hidden = draw.random() < self._spec.obstructed
        return float(draw.uniform(*self._spec.longer_m)) if hidden else 0.0


def in_corners(low_m: Array, high_m: Array, count: int, rng: np.random.Generator) -> tuple[Anchor, ...]:
    """Anchors high on the walls of a room from low (2,) to high (2,): in its corners first, then along its sides."""
    share = np.array([[0, 0], [1, 0.1], [0.4, 1], [1, 1], [0, 1], [0.5, 0], [1, 0.5], [0, 0.5]], np.float64)
    at = low_m + share[:count] * (high_m - low_m)
    return tuple(
        Anchor(f"{0xA000 + i:04X}", x, y, float(rng.uniform(1.8, 2.4))) for i, (x, y) in enumerate(at.tolist())
    )


def surveyed(anchors: tuple[Anchor, ...], sigma_m: float, rng: np.random.Generator) -> tuple[Anchor, ...]:
    """As somebody wrote them down who measured to a standard deviation along each axis."""
    off = sigma_m * rng.standard_normal((len(anchors), 3))
    return tuple(
        Anchor(a.name, a.x_m + float(d[0]), a.y_m + float(d[1]), a.z_m + float(d[2]), sigma_m)
        for a, d in zip(anchors, off, strict=True)
    )
