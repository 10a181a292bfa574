"""The pose samples of a soak against the truth, as columns."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.bench.soak.fault_plan import AFTER_FAULT_S, LEAD_S, Stroke
from ceilvo.bench.soak.parts import Heard
from ceilvo.sim.world import World
from ceilvo.types import GOOD, State

_NS = 1e-9  # s in a nanosecond

Floats = NDArray[np.float64]


class Poses:
    """Columns of the pose samples, times in seconds since the start of the world."""

    def __init__(self, heard: Heard, world: World, t0_ns: int) -> None:
        rows = heard.poses
        self.recv_s: Floats = _NS * (np.array([r.recv_ns for r in rows], np.int64) - t0_ns).astype(np.float64)
        self.t_s: Floats = _NS * (np.array([r.stamp_ns for r in rows], np.int64) - t0_ns).astype(np.float64)
        self.state = np.array([r.state for r in rows], np.int64)
        poses = np.array([(r.x_m, r.y_m, r.theta_rad) for r in rows], np.float64).reshape(-1, 3)
        off = poses - world.truth_at(self.t_s) if len(rows) else poses
        self.error_m: Floats = np.hypot(off[:, 0], off[:, 1])
        self.error_rad: Floats = np.abs(se2.wrap_array(off[:, 2]))
        self.latency_s: Floats = self.recv_s - self.t_s
        self.gap_s: Floats = np.diff(self.recv_s, append=self.recv_s[-1:])

    def inside(self, strokes: Sequence[Stroke], after_s: float = AFTER_FAULT_S) -> NDArray[np.bool_]:
        """Which samples came in a stroke, or up to so long after it."""
        out = np.zeros(len(self.recv_s), bool)
        for s in strokes:
            begin, end = np.searchsorted(self.recv_s, [s.from_s, s.to_s + after_s])
            out[begin:end] = True
        return out

    def quiet(self, plan: Sequence[Stroke]) -> NDArray[np.bool_]:
        """Which samples came when the last stroke was over, and none was under way."""
        return (self.recv_s > LEAD_S / 2) & ~self.inside(plan)

    def first(self, after_s: float, states: Sequence[State], wanted: bool = True) -> float | None:
        """Time since after_s until a pose came whose state is (not) among some."""
        k = int(np.searchsorted(self.recv_s, after_s))
        found = np.flatnonzero(np.isin(self.state[k:], [int(s) for s in states]) == wanted)
        return float(self.recv_s[k + found[0]] - after_s) if len(found) else None

    def flagged_after_s(self, stroke: Stroke) -> float | None:
        """How long after a stroke the pose was no longer called good; None when it was not good before."""
        before = self.state[: int(np.searchsorted(self.recv_s, stroke.from_s))]
        if not len(before) or before[-1] not in GOOD:
            return None
        return self.first(stroke.from_s, GOOD, wanted=False)
