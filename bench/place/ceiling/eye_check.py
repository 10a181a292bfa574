"""The synthetic eye against the real one: the same poses, rendered and found, and made from the true lines.

Both are measured alike: crossings near a true one are that one, whatever their type.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.bench.place.ceiling.eye import SyntheticEye
from ceilvo.bench.place.ceiling.truth import PX_M, Features, Origin, features_of
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.crossing_types import quarter_turns, turned_type
from ceilvo.daemon.vision.finder.crossing_finder import CrossingFinder
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Array, Crossings, Frame, Ints

_FOUND_M = 0.012
"""A crossing so near is the true one; chosen: far above the noise, below half of what any two are apart."""
_INSIDE_PX = 14.0
"""True crossings nearer the border are not asked for: as bench/vision/metrics.py."""
_CLIP_M = 0.001
"""Larger errors of lines count as this in their correlation; chosen: six times their middle 68 %."""
RATE_HZ = 10.0
_STANDS_EVERY = 10
"""Frames; in one of so many the robot is looked at twice; chosen."""


@dataclass
class Score:
    """What one eye gives, frame after frame."""

    features: Features
    calibration: Calibration
    frames: int = 0
    reported: int = 0
    extra: int = 0
    shown: list[Ints] = field(default_factory=list)
    hit: list[Ints] = field(default_factory=list)
    right_type: list[Ints] = field(default_factory=list)
    psi: list[float] = field(default_factory=list)
    common: list[Array] = field(default_factory=list)
    line_error: list[tuple[int, float]] = field(default_factory=list)
    line_pairs: list[tuple[float, float]] = field(default_factory=list)
    standing_m: list[float] = field(default_factory=list)
    _line_errors: dict[int, float] = field(default_factory=dict)
    said_px: list[float] = field(default_factory=list)
    said_tilt: list[float] = field(default_factory=list)
    said_psi: list[float] = field(default_factory=list)

    def add(self, crossings: Crossings | None, pose: Array) -> None:
        self.frames += 1
        f = self.features
        shown = self._shown(pose)
        self.shown.append(shown)
        if crossings is None:
            self.hit.append(np.zeros(0, np.int64))
            return
        seen = se2.transform(pose, crossings.xy_base_m)
        near = f.near(pose[:2], 3.0)
        apart = np.hypot(*(seen[:, None] - f.xy_map_m[near][None]).transpose(2, 0, 1))
        nearest = apart.argmin(axis=1)
        true = near[nearest]
        good = apart[np.arange(len(seen)), nearest] < _FOUND_M
        self.reported += len(seen)
        self.extra += int(np.count_nonzero(~good))
        turns = quarter_turns(crossings.psi_rad + float(pose[2]), f.axis_rad)
        kind = turned_type(crossings.crossing_type, turns)
        self.hit.append(np.unique(true[good]))
        self.right_type.append(np.unique(true[good & (kind == f.crossing_type[true])]))
        direction = f.axis_rad - float(pose[2])
        self.psi.append((crossings.psi_rad - direction + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi)
        self.said_psi.append(crossings.psi_sigma_rad)
        self.said_tilt.append(float(np.mean(crossings.tilt_sigma_rad)))
        own = np.trace(crossings.cov_base_m2 - crossings.common_cov_m2, axis1=1, axis2=2)
        self.said_px.append(float(np.sqrt(0.5 * np.median(own))) / PX_M)
        self._errors(seen[good] - f.xy_map_m[true[good]], true[good])

    def _errors(self, error_map: Array, true: Ints) -> None:
        """Split into what all share and what a line has of its own."""
        f = self.features
        grid = f.feature_origin[true] == Origin.GRID
        if np.count_nonzero(grid) < 4:
            return
        common = np.median(error_map[grid], axis=0)
        self.common.append(common)
        along = (error_map - common) @ se2.rotation(f.axis_rad)
        before, self._line_errors = self._line_errors, {}
        for axis in (0, 1):
            line = f.line[true, axis]
            for k in np.unique(line):
                error = float(along[line == k, axis].mean())
                self.line_error.append((int(f.origin[k]), error))
                if f.origin[k] == Origin.GRID:
                    self._line_errors[int(k)] = error
                    if int(k) in before:
                        self.line_pairs.append((before[int(k)], error))

    def stood(self, first: Crossings | None, second: Crossings | None) -> None:
        """Two views of a robot that stands."""
        if first is not None and second is not None:
            apart = np.hypot(*(first.xy_base_m[:, None] - second.xy_base_m[None]).transpose(2, 0, 1)).min(axis=1)
            self.standing_m.append(float(np.median(apart)))

    def _shown(self, pose: Array) -> Ints:
        f, cal = self.features, self.calibration
        near = f.near(pose[:2], 3.0)
        base = se2.transform(se2.inverse(pose), f.xy_map_m[near])
        s = np.column_stack([base, np.ones(len(base))]) @ cal.level_from_ceiling.T
        raw = cal.level_view.to_raw(s[:, :2] / s[:, 2:])
        size = np.array([cal.camera.width_px, cal.camera.height_px]) - 1.0
        return np.asarray(near[np.all((raw > _INSIDE_PX) & (raw < size - _INSIDE_PX), axis=1)])

    def figures(self) -> dict[str, float]:
        f = self.features
        counts = np.zeros((3, len(f)))
        for row, lists in enumerate((self.shown, self.hit, self.right_type)):
            for which in lists:
                counts[row, which] += 1
        out = {"crossings a frame": self.reported / self.frames, "extra a frame": self.extra / self.frames}
        origin = f.feature_origin
        inside = np.zeros(len(f))
        for s, h in zip(self.shown, self.hit, strict=True):
            inside[np.intersect1d(s, h)] += 1
        right = np.zeros(len(f))
        for s, h in zip(self.shown, self.right_type, strict=False):
            right[np.intersect1d(s, h)] += 1
        for o in Origin:
            of = origin == o
            if counts[0, of].sum():
                out[f"recall {o.name} %"] = 100.0 * inside[of].sum() / counts[0, of].sum()
                out[f"of them right type {o.name} %"] = 100.0 * right[of].sum() / max(inside[of].sum(), 1.0)
        out |= self._line_figures()
        common = np.array(self.common)
        out["common shift rms mm"] = 1e3 * float(np.sqrt(np.mean(common**2)))
        out["common shift a frame apart, correlation"] = float(np.mean(common[1:] * common[:-1]) / np.mean(common**2))
        pairs = np.array(self.line_pairs)
        out["line GRID error a frame apart, correlation"] = float(
            np.corrcoef(np.clip(pairs, -_CLIP_M, _CLIP_M).T)[0, 1]
        )
        out |= self._again()
        out["standing: crossings differ by um"] = 1e6 * float(np.median(self.standing_m))
        out["psi rms mrad"] = 1e3 * float(np.sqrt(np.mean(np.square(self.psi))))
        out["psi said mrad"] = 1e3 * float(np.median(self.said_psi))
        out["line said px"] = float(np.median(self.said_px))
        out["tilt said mrad"] = 1e3 * float(np.median(self.said_tilt))
        return out

    def _again(self) -> dict[str, float]:
        """How often a crossing that is missed in a frame is missed in the next."""
        missed = [np.setdiff1d(s, h) for s, h in zip(self.shown, self.hit, strict=True)]
        out = {}
        for o in Origin:
            again = asked = 0
            for before, shown, now in zip(missed[:-1], self.shown[1:], missed[1:], strict=True):
                still = np.intersect1d(before, shown)
                still = still[self.features.feature_origin[still] == o]
                asked += len(still)
                again += len(np.intersect1d(still, now))
            if asked:
                out[f"missed again {o.name} %"] = 100.0 * again / asked
        return out

    def _line_figures(self) -> dict[str, float]:
        """Errors of lines; how often one with 3 crossings in view gives none, and how often again in the next frame."""
        out = {}
        f = self.features
        errors = np.array(self.line_error)
        missing_before: set[int] = set()
        tally = {o: [0, 0, 0, 0] for o in Origin}
        for shown, hit in zip(self.shown, self.hit, strict=True):
            ids, n = np.unique(f.line[shown], return_counts=True)
            found = set(np.unique(f.line[hit]).tolist())
            missing = {int(k) for k, c in zip(ids, n, strict=True) if c >= 3 and int(k) not in found}
            for k, c in zip(ids.tolist(), n.tolist(), strict=True):
                t = tally[Origin(int(f.origin[k]))]
                if c >= 3:
                    t[0] += 1
                    t[1] += k in missing
                    t[2] += k in missing_before
                    t[3] += k in missing and k in missing_before
            missing_before = missing
        for o in Origin:
            of = errors[errors[:, 0] == o, 1] / PX_M
            if len(of):
                out[f"line {o.name} error px"] = float(np.sqrt(np.mean(of**2)))
                out[f"line {o.name} error, middle 68 %, px"] = 0.5 * float(np.subtract(*np.quantile(of, (0.84, 0.16))))
            seen, missed, before, again = tally[o]
            if seen:
                out[f"line {o.name} missed %"] = 100.0 * missed / seen
                out[f"line {o.name} missed again %"] = 100.0 * again / max(before, 1)
        return out


def compare(seed: int, frames: int) -> tuple[dict[str, float], dict[str, float]]:
    """Figures of the real and of the synthetic eye over the same lap."""
    world = World(WorldSpec(seed=seed))
    features = features_of(world.ceiling.layout, np.zeros(3))
    find = CrossingFinder(world.calibration, Config().features)
    made = SyntheticEye(features, world.calibration, np.random.default_rng(seed))
    real, synthetic = (Score(features, world.calibration) for _ in range(2))
    before: Array | None = None
    rng = np.random.default_rng(seed)
    for k in range(frames):
        t_s = 5.0 + k / RATE_HZ
        pose = world.truth_at(t_s)
        expected = None if before is None else se2.between(before, pose)
        seen = find(Frame(k, k, world.frame_at(t_s)), expected), made.look(pose)
        real.add(seen[0], pose)
        synthetic.add(seen[1], pose)
        if k % _STANDS_EVERY == 0:
            again = world.renderer.render(pose, rng)
            real.stood(seen[0], find(Frame(k, k, again), np.zeros(3)))
            synthetic.stood(seen[1], made.look(pose))
        before = pose
    return real.figures(), synthetic.figures()
