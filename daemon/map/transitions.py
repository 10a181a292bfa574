"""Where a robot gets from one floor to another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from ceilvo.daemon.map.checks import Damage, floats, shown
from ceilvo.json_values import MAX_COORDINATE_M
from ceilvo.types import Array

Kind = Literal["lift", "ramp"]
KINDS: tuple[str, ...] = get_args(Kind)
NAME_CHARS = 80


@dataclass(frozen=True, slots=True)
class Side:
    """One end of a transition, on one floor.

    Attributes:
        name: of the transition, the same on every floor that it leads to.
        kind: of KINDS.
        x_m, y_m, theta_rad: of a robot in it, or at its foot, map_from_base.
    """

    name: str
    kind: str
    x_m: float
    y_m: float
    theta_rad: float

    def __post_init__(self) -> None:
        if not self.name or len(self.name) > NAME_CHARS or not self.name.isprintable():
            raise Damage(f"transition is named {shown(self.name)}, expected up to {NAME_CHARS} printable characters")
        if self.kind not in KINDS:
            raise Damage(f"kind of transition {shown(self.name)} is {shown(self.kind)}, expected {' or '.join(KINDS)}")
        floats(list(self.pose), f"pose of transition {shown(self.name)}", (3,), MAX_COORDINATE_M)

    @property
    def pose(self) -> tuple[float, float, float]:
        return self.x_m, self.y_m, self.theta_rad

    @staticmethod
    def at(name: str, kind: str, pose: Array) -> Side:
        """From a pose (3,) [m, m, rad]."""
        x, y, theta = (float(v) + 0.0 for v in np.asarray(pose))
        return Side(name, kind, x, y, theta)
