"""One condition of the vision bench: render, run the pipeline and the baselines, measure."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.bench.vision.baselines import Baseline, DescriptorMatcher, PointTracker
from ceilvo.bench.vision.claims import GapScore, TrackingScore
from ceilvo.bench.vision.condition import Condition
from ceilvo.bench.vision.metrics import CrossingScore, MotionScore
from ceilvo.config import Config
from ceilvo.config.reader import replace as replace_keys
from ceilvo.daemon.pipeline import START_SIGMA, Pipeline
from ceilvo.daemon.relocalisation.doubts import JUST_NOW_S
from ceilvo.daemon.replay.drawing.overlay import draw_overlay, previous_pixels
from ceilvo.errors import FileFormatError
from ceilvo.sim.world import World
from ceilvo.types import Array, Frame, Pose

STAGES = ("edges", "lines", "crossings", "odometry", "filter")
_BLACKOUT_S = 1.0  # docs/bench.md (blackout)
_PICTURE_AT = 0.42  # share of the run; chosen: after the blackouts


@dataclass(frozen=True)
class Options:
    """What one run is asked for.

    Attributes:
        seconds: world time to drive; None = one lap.
        pictures: folder for the overlay of one frame; None = none.
        baselines: also run KLT and ORB.
        overrides: `section.key=value` each, on top of the default configuration.
    """

    seconds: float | None = None
    pictures: Path | None = None
    baselines: bool = True
    overrides: tuple[str, ...] = ()


class StageTimes:
    """CPU time of this thread, stage by stage; a lap callback for Pipeline.step."""

    def __init__(self) -> None:
        self._frames: list[dict[str, float]] = []
        self._last = 0.0

    def start(self) -> None:
        """A new frame begins."""
        self._frames.append({})
        self._last = time.thread_time()

    def lap(self, stage: str) -> None:
        now = time.thread_time()
        self._frames[-1][stage] = self._frames[-1].get(stage, 0.0) + now - self._last
        self._last = now

    def total(self, stages: tuple[str, ...]) -> Array:
        """(frames,) s; a stage that a frame did without counts nothing."""
        return np.array([sum(frame.get(s, 0.0) for s in stages) for frame in self._frames])


def run(
    condition: Condition, options: Options, progress: Callable[[int], None] = lambda frames: None
) -> dict[str, float]:
    """Figures of one condition by name; `progress` is told about every frame."""
    cv2.setNumThreads(1)
    world = condition.world()
    seconds = options.seconds if options.seconds is not None else condition.lap_s
    frames = max(int(seconds * condition.fps), 2)
    middle_s = 0.5 * world.spec.render.exposure_s
    config = replace_keys(Config(), (*condition.overrides, *options.overrides))
    pipeline = _pipeline(condition, config)
    if condition.known:
        pipeline = _started_again(
            pipeline, condition, config, (_seen(condition, world, seconds, k) for k in range(frames))
        )
    crossings = CrossingScore(world, condition.calibration)
    motions = MotionScore(world.truth_at(middle_s))
    tracking = TrackingScore(world.truth_at(middle_s), 1.0 / condition.fps)
    gaps = GapScore()
    rivals = _Rivals(condition, motions_start=world.truth_at(middle_s)) if options.baselines else None
    times = StageTimes()
    for k in range(frames):
        t_s = k / condition.fps
        frame = _seen(condition, world, seconds, k)
        true, tilt = world.truth_at(t_s + middle_s), world.tilt_at(t_s + middle_s)
        times.start()
        cv2.Canny(frame.gray, 30, 70, L2gradient=True)
        times.lap("canny")
        estimate = pipeline.step(frame, on_stage_done=times.lap)
        view = pipeline.vision.view
        if not _dark(condition, t_s / seconds, seconds):
            crossings.add(view.crossings if view else None, true, tilt)
        motions.add(estimate.motion, true)
        tracking.add(estimate, true)
        gaps.add(estimate.motion, true)
        if rivals is not None:
            rivals.step(frame.gray, true)
        if options.pictures is not None and k == int(_PICTURE_AT * frames) and view is not None:
            previous = None
            if view.crossings is not None and estimate.motion.ok:
                previous = previous_pixels(view.crossings, estimate.motion, condition.calibration)
            level = condition.calibration.level_view
            picture = draw_overlay(frame.gray, view.lines, view.crossings, level, previous, scale=2)
            save_picture(options.pictures / f"{condition.name}.png", picture)
        progress(1)
    path_m = float(world.path.travel_at(frames / condition.fps))
    figures = {"frames": float(frames), "path_m": path_m, **crossings.figures()}
    figures |= {**motions.figures(path_m), **tracking.figures(), **gaps.figures()}
    figures.update(_time_figures(times))
    if rivals is not None:
        figures.update(rivals.figures(path_m, float(np.median(times.total(("canny",))))))
    return figures


def save_picture(file: Path, picture: NDArray[np.uint8]) -> None:
    """Raises FileFormatError where it cannot be written."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(file), picture):
        raise FileFormatError(f"{file}: cannot be written; check the folder and the disk")


def _dark(condition: Condition, fraction: float, seconds: float) -> bool:
    return any(0.0 <= (fraction - start) * seconds < _BLACKOUT_S for start in condition.blackouts_s)


def _seen(condition: Condition, world: World, seconds: float, k: int) -> Frame:
    """The frame, or what a sensor without light gives."""
    t_s = k / condition.fps
    gray = world.frame_at(t_s)
    if _dark(condition, t_s / seconds, seconds):
        noise = np.random.default_rng([7, k]).normal(2.0, 1.2, gray.shape)
        gray = np.asarray(np.clip(np.rint(noise), 0, 255), np.uint8)
    return Frame(k, 1_000_000_000 + round(t_s * 1e9), gray)


def _pipeline(condition: Condition, config: Config) -> Pipeline:
    return Pipeline(condition.calibration, config, np.random.default_rng(1))


def _started_again(pipeline: Pipeline, condition: Condition, config: Config, frames: Iterable[Frame]) -> Pipeline:
    """Another one on the map, with the heights, that the first learns on these frames; where these began, just now."""
    for frame in frames:
        pipeline.step(frame)
    again, axis_rad = _pipeline(condition, config), pipeline.relocaliser.state.map_axis_rad or 0.0
    start, cov = Pose(np.zeros(3)), np.diag(START_SIGMA**2)
    ceiling = pipeline.odometry.ceiling(pipeline.filter.estimate()[0])
    again.load_map(pipeline.landmarks(), axis_rad, start, cov, ago_s=JUST_NOW_S, ceiling=ceiling)
    return again


def _time_figures(times: StageTimes) -> dict[str, float]:
    """ms, and ratios to the median of bare Canny on the same frames; the first frames warm caches and do not count."""
    canny = float(np.median(times.total(("canny",))))
    total = times.total(STAGES)[5:]
    out = {"canny_ms": 1e3 * canny}
    for name, s in (("median", float(np.median(total))), ("p99", float(np.quantile(total, 0.99)))):
        out |= {f"time_{name}": s / canny, f"step_{name}_ms": 1e3 * s}
    for stage in STAGES:
        out[f"time_{stage}"] = float(np.median(times.total((stage,)))) / canny
    return out


class _Rivals:
    def __init__(self, condition: Condition, motions_start: Array) -> None:
        self._methods: dict[str, Baseline] = {
            "klt": PointTracker(condition.calibration),
            "orb": DescriptorMatcher(condition.calibration),
        }
        self._poses = {name: np.array(motions_start) for name in self._methods}
        self._worst_m = dict.fromkeys(self._methods, 0.0)
        self._times: dict[str, list[float]] = {name: [] for name in self._methods}

    def step(self, gray: NDArray[np.uint8], true: Array) -> None:
        for name, method in self._methods.items():
            start = time.thread_time()
            motion = method.step(gray)
            self._times[name].append(time.thread_time() - start)
            self._poses[name] = se2.compose(self._poses[name], motion)
            off = float(np.hypot(*(self._poses[name] - true)[:2]))
            self._worst_m[name] = max(self._worst_m[name], off)

    def figures(self, path_m: float, canny_s: float) -> dict[str, float]:
        out = {}
        for name, worst_m in self._worst_m.items():
            out[f"{name}_drift_pct"] = 100.0 * worst_m / path_m if path_m > 0 else float("nan")
            out[f"{name}_time"] = float(np.median(self._times[name])) / canny_s
        return out
