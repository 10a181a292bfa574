"""What hangs in a ceiling: lamps, vents and diffusers, which are rectangles, and round spots."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

Rect = tuple[float, float, float, float]
"""x0, y0, x1, y1 in metres, in the ceiling's own axes."""
PanelKind = Literal["lamp", "vent", "diffuser", "grille", "dark"]
"""The last is an opening with nothing in it, or a lamp that is off."""
SpotKind = Literal["sprinkler", "detector", "speaker"]
SPOTS: tuple[tuple[SpotKind, float], ...] = (("sprinkler", 0.038), ("detector", 0.055), ("speaker", 0.105))
"""Radius m; chosen: about what such things have."""
_SLOT_FROM, _SLOT_TO = 0.15, 0.60
"""Where a vent's dark slot begins and ends in the pitch of its slats; chosen, dark and bright about equal."""
_RING_PITCH_M, _RING_M = 0.075, 0.028
"""Of a diffuser's rings, and how wide the dark part is; chosen."""
_CELL_M, _BLADE_M = 0.05, 0.010
"""Pitch of a grille's square cells, about, and how wide its blades are; chosen, as louvres of 50 mm have."""
_RING_CENTRE_M = 0.03
"""Half the side of a diffuser's middle, which has no rings."""


@dataclass(frozen=True)
class Panel:
    """Something rectangular in the ceiling.

    Attributes:
        rect: outer rectangle x0, y0, x1, y1 in metres.
        axis: a vent's slats run along x (0) or y (1).
        recessed: in the grid's place, not screwed on with a gap around it.
        round: a disc in the middle of the rectangle, as wide as its shorter side.
    """

    kind: PanelKind
    rect: Rect
    axis: int
    recessed: bool = True
    round: bool = False

    RIM_M = 0.030
    """Width of the frame around a lamp's field or a vent's opening; chosen, as the two below."""
    GAP_M = 0.007
    """Dark gap around what is screwed on."""
    SLAT_M = 0.050
    """Pitch of a vent's slats, about."""

    @property
    def inner(self) -> Rect:
        """Luminous field or opening, inside the rim, which a dark panel has not."""
        return self.rect if self.kind == "dark" else grown(self.rect, -self.RIM_M)

    def steps(self) -> list[Rect]:
        """Dark rectangles in a vent's opening: slots between slats, or nothing for a lamp and a diffuser."""
        if self.kind != "vent":
            return []
        x0, y0, x1, y1 = self.inner
        lo, hi = (x0, x1) if self.axis == 1 else (y0, y1)
        n = max(1, round((hi - lo) / self.SLAT_M))
        pitch = (hi - lo) / n
        slots = [(lo + (i + _SLOT_FROM) * pitch, lo + (i + _SLOT_TO) * pitch) for i in range(n)]
        if self.axis == 1:
            return [(a, y0, b, y1) for a, b in slots]
        return [(x0, a, x1, b) for a, b in slots]

    def rings(self) -> list[Rect]:
        """Nested rectangles of a diffuser, outermost first, alternately dark and bright."""
        if self.kind != "diffuser":
            return []
        x0, y0, x1, y1 = self.inner
        half = 0.5 * min(x1 - x0, y1 - y0)
        rings = 1 + int(half / _RING_PITCH_M)
        insets = [
            d
            for i in range(rings)
            for d in (_RING_PITCH_M * i, _RING_PITCH_M * i + _RING_M)
            if d < half - _RING_CENTRE_M
        ]
        return [(x0 + d, y0 + d, x1 - d, y1 - d) for d in insets]

    def blades(self) -> list[Rect]:
        """Bright bars of a grille, both ways across its dark opening."""
        if self.kind != "grille":
            return []
        x0, y0, x1, y1 = self.inner
        h = 0.5 * _BLADE_M
        across = [(x - h, y0, x + h, y1) for x in _between(x0, x1, _CELL_M)]
        return across + [(x0, y - h, x1, y + h) for y in _between(y0, y1, _CELL_M)]

    def joints(self) -> list[Rect]:
        """Rectangles along the middles of what is narrow and dark: gap, slots, rings."""
        out = [] if self.recessed else [grown(self.rect, 0.5 * self.GAP_M)]
        rings = self.rings()
        for outer, inner in zip(rings[0::2], rings[1::2], strict=False):
            out.append(grown(outer, 0.5 * (outer[0] - inner[0])))
        for x0, y0, x1, y1 in self.steps():
            x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
            out.append((x, y0, x, y1) if self.axis == 1 else (x0, y, x1, y))
        return out

    def hides(self, x: float, y: float) -> bool:
        """Whether a groove at this point lies behind the panel."""
        x0, y0, x1, y1 = self.rect
        if self.round:
            return math.hypot(x - 0.5 * (x0 + x1), y - 0.5 * (y0 + y1)) < 0.5 * min(x1 - x0, y1 - y0)
        return x0 < x < x1 and y0 < y < y1


@dataclass(frozen=True)
class Spot:
    """Something round: a sprinkler's plate, a smoke detector, a loudspeaker's grille."""

    kind: SpotKind
    xy: tuple[float, float]
    radius_m: float


def _between(lo: float, hi: float, pitch: float) -> list[float]:
    """Places that part an interval into equal pieces of about a pitch."""
    n = max(1, round((hi - lo) / pitch))
    return [lo + (hi - lo) * i / n for i in range(1, n)]


def grown(rect: Rect, by: float) -> Rect:
    return (rect[0] - by, rect[1] - by, rect[2] + by, rect[3] + by)
