"""The project's filters on a recorded robot: known map, SLAM, global start, kidnap.

A range and a bearing become a point in base whose noise is long across or along the line of sight, not along base x and
y. The filters take variances along base x and y, so base is turned to the line of sight before each observation and
back after the last one of a moment (predictions that turn exactly, without noise): nothing is approximated.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ceilvo.bench.mrclam.data import Run, World
from ceilvo.bench.mrclam.noise import Noise
from ceilvo.bench.paper.run import known_map, labels_of, mahalanobis2, rms
from ceilvo.bench.recovery.filters import make_recovering_filter as make_filter
from ceilvo.config import Filter
from ceilvo.daemon.odometry.rigid import rigid_motion
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.se2 import between, transform, wrap_array
from ceilvo.types import Array, Displacement, Ints, Landmarks, Motion, Observations

GRID_S = 0.5
"""Between observations the filters predict this often."""
START_SIGMA = np.array([0.01, 0.01, 0.01])  # m, m, rad; chosen: the start is the truth, which a motion capture gives
FOUND_M = 0.5  # m, docs/experiments.md (Recorded robots)
FOUND_FOR_S = 10.0
"""A pose is found when the error stays below FOUND_M for this long, counted from its beginning."""
WATCH_S = 60.0  # given for finding the pose; docs/experiments.md
SETTLE_S = 30.0  # driven before a jump; chosen: half of WATCH_S, for the filter to converge
JUMP_S = 60.0  # cut out of a run; docs/experiments.md
JUMP_MIN_M = 1.0
"""A jump over which the robot moved less than this is no kidnap, and is not tried."""
WRONG_TURNS = 0.6
"""Task odometry: the robot turns by this share of what its wheels say, all the time; docs/experiments.md."""
AGREES_SIGMAS = 3.0  # of a range; docs/experiments.md (Observations)
FILTERS = ("ukf", "ukf_gated", "pf", "pfcf_paper", "joint")


@dataclass(frozen=True)
class Event:
    """A moment: odometry since the last one, true pose (nan = unknown), observations in polar coordinates (K,)."""

    t_s: float
    motion: Array
    seconds: float
    truth: Array
    subject: Ints
    range_m: Array
    bearing_rad: Array
    on_grid: bool


def events(run: Run) -> list[Event]:
    """All moments of a run: a grid of 0.5 s and every time stamp with observations."""
    grid = np.arange(run.begin_s, run.end_s, GRID_S)
    t = np.union1d(grid, run.seen_s)
    pose, truth = run.dead_reckoning(t), run.truth_at(t)
    motion = np.concatenate([np.zeros((1, 3)), between(pose[:-1], pose[1:])])
    seconds = np.diff(t, prepend=t[0])
    first, last = np.searchsorted(run.seen_s, t, "left"), np.searchsorted(run.seen_s, t, "right")
    on_grid = np.isin(t, grid)
    return [
        Event(
            float(t[i]),
            motion[i],
            float(seconds[i]),
            truth[i],
            run.subject[a:b],
            run.range_m[a:b],
            run.bearing_rad[a:b],
            bool(on_grid[i]),
        )
        for i, (a, b) in enumerate(zip(first, last, strict=True))
    ]


def settings(name: str, particles: int) -> Filter:
    """The defaults, but that features err independently and the kinds are identities."""
    return replace(
        Filter(),
        method="ukf" if name == "ukf_gated" else name,
        ukf_gate=name != "ukf",
        particles=particles,
        feature_independence=1.0,
        association_gate_m=1.0,
    )


def make(name: str, particles: int, seed: int) -> PoseFilter:
    return make_filter(settings(name, particles), np.random.default_rng(seed))


def step(f: PoseFilter, event: Event, noise: Noise) -> None:
    """Predict to the moment of an event, then update with its observations, one after the other."""
    f.predict(Motion(Displacement(event.motion), noise.motion_cov(event.motion, event.seconds), 0, 0.0, by_wheels=True))
    turned = 0.0
    for i, bearing in enumerate(event.bearing_rad):
        kind = event.subject[i : i + 1].astype(np.int64)
        known = f.landmarks()
        label = labels_of(kind, known)
        variance = point_variance(noise, float(event.range_m[i]), _expected_m(f, known, int(label[0])))
        _turn(f, float(bearing) - turned)
        turned = float(bearing)
        f.update(Observations(np.array([[event.range_m[i], 0.0]]), variance, kind, label))
    if turned:
        _turn(f, -turned)


def point_variance(noise: Noise, range_m: float, expected_m: float) -> Array:
    """(1, 2) variance along and across the line of sight of the point that a range and a bearing make.

    Noise grows with the true distance: across, a bearing's error moves the point by distance times error. The best
    estimate of the distance is what pose and map say, where that agrees with the range; the range itself is noisy.
    """
    along, _ = noise.sigmas(np.array([range_m]))
    agrees = abs(expected_m - range_m) < AGREES_SIGMAS * float(along[0])
    at = np.array([expected_m if agrees else range_m])
    along, across = noise.sigmas(at)
    return np.column_stack([along**2, (at * across) ** 2])


def _expected_m(f: PoseFilter, known: Landmarks, label: int) -> float:
    return float(np.hypot(*(known.xy_map_m[label] - f.estimate()[0][:2]))) if label >= 0 else float("inf")


def _turn(f: PoseFilter, angle_rad: float) -> None:
    f.predict(Motion(Displacement(np.array([0.0, 0.0, angle_rad])), np.zeros((3, 3)), 0, 0.0))


def follow(f: PoseFilter, moments: Sequence[Event], noise: Noise) -> Iterator[tuple[Event, Array, Array, float]]:
    """Every event with estimate, covariance and the processor time that its step took in s."""
    for event in moments:
        begun = time.process_time()
        step(f, event, noise)
        pose, cov, _ = f.estimate()
        yield event, pose, cov, time.process_time() - begun


def start_on_map(f: PoseFilter, world: World, pose: Array, anywhere: bool = False) -> None:
    cov = np.full((3, 3), np.inf) if anywhere else np.diag(START_SIGMA**2)
    f.reset(pose, cov, known_map(world.xy_m, world.subject), known=True)


def wrong_turns(run: Run) -> Run:
    """The run with wheels that report too much of every turn."""
    return replace(run, odometry=run.odometry * [1.0, 1.0, 1.0 / WRONG_TURNS])


def localise(f: PoseFilter, run: Run, world: World, noise: Noise) -> dict[str, float]:
    """Known map, start at the truth: see scored()."""
    moments = from_truth(events(run))
    start_on_map(f, world, moments[0].truth)
    return scored(list(follow(f, moments, noise)))


def scored(path: Sequence[tuple[Event, Array, Array, float]]) -> dict[str, float]:
    """Errors and consistency at the moments with observations; rmse_over_time_m counts the blind stretches too."""
    path = [row for row in path if np.isfinite(row[0].truth[0])]
    off = np.array([pose[:2] - e.truth[:2] for e, pose, _, _ in path])
    error = np.hypot(*off.T)
    seen, grid = np.array([len(e.subject) > 0 for e, *_ in path]), np.array([e.on_grid for e, *_ in path])
    cov = np.array([c[:2, :2] for _, _, c, _ in path])
    turn = wrap_array(np.array([pose[2] - e.truth[2] for e, pose, _, _ in path]))
    nees = np.array([mahalanobis2(o, c) for o, c in zip(off, cov, strict=True)])
    observations = sum(len(e.subject) for e, *_ in path)
    return {
        "rmse_m": rms(error[seen]),
        "rmse_over_time_m": rms(error[grid]),
        "max_m": float(np.max(error[seen])),
        "theta_rmse_deg": float(np.degrees(rms(turn[seen]))),
        "nees_mean": float(np.mean(nees[seen])),
        "nees_median": float(np.median(nees[seen])),
        "nll_mean": float(np.mean(0.5 * (nees + np.linalg.slogdet(cov)[1])[seen])),
        "us_per_update": 1e6 * sum(s for e, _, _, s in path if len(e.subject)) / max(observations, 1),
    }


def slam(f: PoseFilter, run: Run, world: World, noise: Noise) -> dict[str, float]:
    """No map; errors of path and landmarks after the best rigid alignment of the path."""
    moments = from_truth(events(run))
    f.reset(moments[0].truth, np.diag(START_SIGMA**2))
    seen = [(e.truth[:2], pose[:2]) for e, pose, _, _ in follow(f, moments, noise) if len(e.subject)]
    true, estimated = (np.array(x) for x in zip(*seen, strict=True))
    known = np.isfinite(true[:, 0])
    true_from_estimated = rigid_motion(estimated[known], true[known])
    m = f.landmarks()
    index = {int(s): i for i, s in enumerate(world.subject)}
    at = world.xy_m[[index[int(k)] for k in m.crossing_type]]
    return {
        "rmse_aligned_m": rms(np.hypot(*(transform(true_from_estimated, estimated[known]) - true[known]).T)),
        "rmse_m": rms(np.hypot(*(estimated[known] - true[known]).T)),
        "landmark_rmse_aligned_m": rms(np.hypot(*(transform(true_from_estimated, m.xy_map_m) - at).T))
        if len(m)
        else float("nan"),
        "landmarks": float(len(m)),
    }


def from_truth(moments: list[Event]) -> list[Event]:
    """From the first moment whose truth is known."""
    first = next(i for i, e in enumerate(moments) if np.all(np.isfinite(e.truth)))
    return moments[first:]


def global_start(f: PoseFilter, moments: Sequence[Event], world: World, noise: Noise) -> float:
    """Seconds from the first observation until the pose is found, infinite when it is not."""
    start_on_map(f, world, np.zeros(3), anywhere=True)
    return _found_after(f, moments, noise, moments[0].t_s)


def kidnap(f: PoseFilter, moments: Sequence[Event], at: int, world: World, noise: Noise) -> float:
    """Seconds after a jump until the pose is found; moments[at] is the first after it, told no odometry."""
    start_on_map(f, world, moments[0].truth)
    for _ in follow(f, moments[:at], noise):
        pass
    after = [replace(moments[at], motion=np.zeros(3), seconds=0.0), *moments[at + 1 :]]
    return _found_after(f, after, noise, after[0].t_s)


def _found_after(f: PoseFilter, moments: Sequence[Event], noise: Noise, since_s: float) -> float:
    begin: float | None = None
    for event, pose, _, _ in follow(f, moments, noise):
        if not np.isfinite(event.truth[0]):
            continue
        wrong = float(np.hypot(*(pose - event.truth)[:2])) > FOUND_M
        begin = None if wrong else event.t_s if begin is None else begin
        if begin is not None and event.t_s - begin >= FOUND_FOR_S:
            return begin - since_s
    return float("inf")


def start_trials(run: Run, count: int) -> list[list[Event]]:
    """Pieces of a run that begin with an observation, spread over it."""
    moments = events(run)
    firsts = [i for i, e in enumerate(moments) if len(e.subject) and e.t_s < run.end_s - WATCH_S - FOUND_FOR_S]
    chosen = [firsts[int(k)] for k in np.linspace(0, len(firsts) - 1, count)] if firsts else []
    return [_until(moments, i, moments[i].t_s + WATCH_S + FOUND_FOR_S) for i in chosen]


def kidnap_trials(run: Run, count: int) -> list[tuple[list[Event], int]]:
    """Pieces of a run out of which 60 s are cut, with the index of the first moment after the cut."""
    moments = events(run)
    t = np.array([e.t_s for e in moments])
    out = []
    last = run.end_s - JUMP_S - WATCH_S - FOUND_FOR_S
    for begin in np.linspace(run.begin_s, last - SETTLE_S, count) if last - SETTLE_S > run.begin_s else []:
        a, cut, after = np.searchsorted(t, [begin, begin + SETTLE_S, begin + SETTLE_S + JUMP_S])
        moved = moments[after].truth[:2] - moments[cut].truth[:2]
        if np.all(np.isfinite(moments[a].truth)) and float(np.hypot(*moved)) >= JUMP_MIN_M:
            rest = _until(moments, int(after), t[after] + WATCH_S + FOUND_FOR_S)
            out.append(([*moments[a:cut], *rest], int(cut - a)))
    return out


def _until(moments: list[Event], first: int, end_s: float) -> list[Event]:
    return [e for e in moments[first:] if e.t_s <= end_s]


def stated() -> dict[str, Any]:
    """Everything here that decides figures."""
    return {
        "grid_s": GRID_S,
        "agrees_sigmas": AGREES_SIGMAS,
        "wrong_turns": WRONG_TURNS,
        "start_sigma": list(START_SIGMA),
        "found_m": FOUND_M,
        "found_for_s": FOUND_FOR_S,
        "watch_s": WATCH_S,
        "settle_s": SETTLE_S,
        "jump_s": JUMP_S,
        "jump_min_m": JUMP_MIN_M,
    }
