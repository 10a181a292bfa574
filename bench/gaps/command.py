"""Claims of odometry against truth: `make bench-gaps`.

Coasting: normalised errors of the prediction over gaps in random drives. Displacements: pairs of rendered views, with a
prediction that is as wrong as it says; how often a displacement that is claimed with some doubt is wrong.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from ceilvo import se2
from ceilvo.config import Config
from ceilvo.daemon.odometry.alternatives import Prior, find_candidates
from ceilvo.daemon.odometry.coasting import LastTwist, coast
from ceilvo.daemon.odometry.lines.direction import direction_change
from ceilvo.daemon.vision.crossings import cross
from ceilvo.daemon.vision.finder.line_finder import LineFinder
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.wander import Wander, driven
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Array, Crossings

RATE_HZ = 10.0
_SECONDS = 22.0
"""Of each rendered drive; chosen: one lap of a room of 5 m at 0.6 m/s."""
_DRIVES, _DRIVE_S = 20, 60.0
_GAPS_S = (0.2, 0.5, 1.0, 2.0, 4.0)
"""Without vision; chosen."""
_PAIRS_S = (0.3, 0.7, 1.2, 2.0)
"""Between the two views of a pair; chosen: beyond it the views share little."""
_SIGMA = np.array([0.5, 0.5, 0.8])
"""[m, m, rad] of the prediction that a pair is given; chosen: what coasting has after 1.5 s."""
_CARRIED = 1e-5
_RIGHT_M, _RIGHT_RAD = 0.03, 0.05
"""A displacement nearer to the truth is the true one; chosen: a tenth of the smallest tile."""
_CLASSES = (0.0, 1e-6, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 1.0)
"""Of doubt."""
_CEILINGS = (
    (CeilingSpec(), 0.35),
    (CeilingSpec(), 0.8),
    (CeilingSpec(lamp_every=(6, 5), vents=8), 0.35),
    (CeilingSpec(tile_m=0.625, lamp_every=(3, 4)), 0.35),
    (CeilingSpec(tile_m=0.3), 0.6),
    (CeilingSpec(lamp_every=(0, 0), vents=0), 0.35),
)
"""With the speed m/s at which the robot drives below them; chosen: many lamps, few and none, three sizes of tiles."""


@dataclass(frozen=True)
class Claim:
    """One pair of views: the doubt that is claimed, and whether the likeliest displacement is the true one."""

    doubt: float
    right: bool


def coasting_errors(fast: bool, gap_s: float, seed: int) -> Array:
    """(N,) normalised errors squared of predictions over a gap, per degree of freedom."""
    out, ahead, config = [], round(gap_s * RATE_HZ), Config().odometry
    for k in range(_DRIVES):
        poses = np.array(list(driven(Wander(seed + k, fast), np.zeros(3), _DRIVE_S, RATE_HZ)))
        for i in range(1, len(poses) - ahead, ahead):
            twist = se2.between(poses[i - 1], poses[i]) * RATE_HZ
            guess, cov = coast(config, LastTwist(twist, 1.0 / RATE_HZ, 0.0), gap_s)
            off = se2.between(poses[i], poses[i + ahead]) - guess
            off[2] = se2.wrap(float(off[2]))
            out.append(float(off @ np.linalg.solve(cov, off)) / 3.0)
    return np.array(out)


def claims(spec: CeilingSpec, speed_mps: float, seed: int, rng: np.random.Generator) -> Iterator[Claim]:
    """Of all pairs of views in one rendered drive."""
    truth, views = _views(World(WorldSpec(seed=seed, ceiling=spec, lap=LapSpec(speed_mps=speed_mps))))
    for apart_s in _PAIRS_S:
        k = round(apart_s * RATE_HZ)
        for i in range(len(views) - k):
            ref, curr = views[i], views[i + k]
            if ref is None or curr is None:
                continue
            true = se2.between(truth[i], truth[i + k])
            mean = true + rng.standard_normal(3) * _SIGMA
            turn = direction_change(ref.psi_rad, curr.psi_rad, float(mean[2]))
            found = find_candidates(ref, curr, turn, Prior(mean, np.diag(_SIGMA**2), _CARRIED))
            yield Claim(found.doubt(), bool(len(found)) and _is_right(found.ref_from_curr[0], true))


def _is_right(found: Array, true: Array) -> bool:
    off = found - true
    return bool(np.hypot(off[0], off[1]) < _RIGHT_M and abs(se2.wrap(float(off[2]))) < _RIGHT_RAD)


def _views(world: World) -> tuple[Array, list[Crossings | None]]:
    finder, out = LineFinder(world.calibration, Config().features), []
    times = 1.0 + np.arange(round(_SECONDS * RATE_HZ)) / RATE_HZ
    for t in times:
        lines = finder(world.frame_at(float(t)), None)
        out.append(None if lines is None else cross(lines, world.calibration, finder.config))
    return world.truth_at(times + 0.5 * world.spec.render.exposure_s), out


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m ceilvo.bench.gaps", description=__doc__)
    parser.add_argument("--seed", type=int, default=901, help="of the first ceiling and the first drive")
    args = parser.parse_args(arguments)
    cv2.setNumThreads(1)
    console = Console()
    table = Table("gap s", "slow: mean", "p99", "max", "fast: mean", "p99", "max", title="Coasting: NEES / 3")
    for gap_s in _GAPS_S:
        row = [f"{gap_s:g}"]
        for fast in (False, True):
            errors = coasting_errors(fast, gap_s, args.seed)
            row += [f"{errors.mean():.2f}", f"{np.quantile(errors, 0.99):.1f}", f"{errors.max():.1f}"]
        table.add_row(*row)
    console.print(table)
    rng, found = np.random.default_rng(args.seed), list[Claim]()
    for k, (spec, speed_mps) in enumerate(_CEILINGS):
        found += claims(spec, speed_mps, args.seed + k, rng)
    doubt, right = np.array([c.doubt for c in found]), np.array([c.right for c in found])
    table = Table("doubt", "pairs", "claimed wrong", "wrong", title=f"Displacements of {len(found)} pairs of views")
    for low, high in pairwise(_CLASSES):
        some = (doubt >= low) & ((doubt < high) | (high == 1.0))
        if np.any(some):
            wrong = int(np.count_nonzero(~right[some]))
            row = [f"{low:g} to {high:g}", str(np.count_nonzero(some)), f"{doubt[some].mean():.1e}"]
            table.add_row(*row, f"{wrong / np.count_nonzero(some):.1e} ({wrong})")
    console.print(table)
    return 0
