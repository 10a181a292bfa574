"""Edge points of a frame as rays, in the groups that lines are looked for in."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.vision import kernel
from ceilvo.daemon.vision.kernel.arguments import Ends
from ceilvo.types import Array

Array32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Points:
    """Edge points as rays (x, y, 1), (P,) each, none further than `reach` from the centre.

    `ends` bounds the four groups (see kernel/reference.py).
    """

    x: Array32
    y: Array32
    ends: Ends
    reach: float

    def stride_for(self, count: int) -> int:
        """Taking every so many-th point leaves about `count`."""
        return max(len(self.x) // count, 1)

    def turned_back(self, tilt_rad: Array) -> Points:
        """As a level robot would see them, when this one tilts by (2,)."""
        x, y = kernel.project(self.x, self.y, len(self.x), 0.0, tilt_rad)
        return Points(x, y, self.ends, float(np.max(np.hypot(x, y), initial=0.0)))

    def thinned(self, stride: int) -> Points:
        """Every stride-th point of each group."""
        at = [slice(a, b, stride) for a, b in pairwise(self.ends)]
        x, y = ([v[s] for s in at] for v in (self.x, self.y))
        a, b, c, d, e = np.cumsum([0, *(len(v) for v in x)]).tolist()
        return Points(np.concatenate(x), np.concatenate(y), (a, b, c, d, e), self.reach)
