"""One filter on one recording: errors, consistency, recovery."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

import numpy as np

from ceilvo.bench.paper.filters import make
from ceilvo.bench.paper.world import (
    DT_S,
    LAP_STEPS,
    SETTINGS,
    Recording,
    Scene,
    Setting,
    Step,
    grid_scene,
    record,
    room_scene,
)
from ceilvo.bench.recovery.recovering_filter import SURE
from ceilvo.config import States
from ceilvo.daemon.integrity.states import Evidence, StateMachine
from ceilvo.daemon.slam.pose_filter import PoseFilter, chi_square_bounds
from ceilvo.types import (
    NO_LANDMARK,
    UNLABELLED,
    Array,
    FilterHealth,
    Ints,
    Landmarks,
    Observations,
    State,
)

START_SIGMA = np.array([1e-3, 1e-3, 1e-3])
"""m, m, rad: the start is known."""
LOST_M = 0.25
"""Farther off than this is another pose."""
KIDNAP_STEP = 50  # 10 s after the start; chosen: the filter has settled by then
WATCH_STEPS = 100
"""20 s after a kidnap, and of a global start."""
LAPS = 3  # of laps3; chosen: enough to see whether errors grow from lap to lap
KEEP_EVERY = 9
"""Every ninth NEES is kept for medians over all runs: neighbours are much alike."""
EXPERIMENTS = ("lap", "laps3", "grid", "kidnap", "global", "slips")
MAPPED = ("lap", "laps3", "slips")
"""Experiments that begin without a map and with labels."""


@dataclass(frozen=True, order=True)
class Cell:
    """One run: what is stored under, and all that it depends on besides the code."""

    experiment: str
    setting: str
    filter: str
    particles: int
    seed: int


Figures = dict[str, float | list[float]]


def run(cell: Cell) -> Figures:
    """The figures of a cell. The recording depends on experiment, setting and seed alone."""
    setting = SETTINGS[cell.setting]
    index = EXPERIMENTS.index(cell.experiment)
    world = np.random.default_rng([cell.seed, index, 0])
    unlabelled = cell.experiment in ("grid", "kidnap", "global")
    f = make(cell.filter, cell.particles, setting, np.random.default_rng([cell.seed, index, 1]), unlabelled)
    if cell.experiment in MAPPED:
        laps = LAPS if cell.experiment == "laps3" else 1
        scene = room_scene(world, setting.features_per_side)
        return mapping(f, record(setting, scene, world, laps * LAP_STEPS), labelled=True)
    if cell.experiment == "grid":
        return mapping(f, record(setting, grid_scene(world, False), world), labelled=False)
    return on_a_map(f, recovery_recording(cell.experiment, setting, world), cell.experiment == "global")


def recovery_recording(experiment: str, setting: Setting, world: np.random.Generator) -> Recording:
    """Known unlabelled grid with lamps and vents, beginning anywhere on the lap."""
    scene, first = grid_scene(world, True), int(world.integers(LAP_STEPS))
    if experiment == "global":
        return record(setting, scene, world, WATCH_STEPS, first)
    return record(setting, scene, world, KIDNAP_STEP + WATCH_STEPS, first, KIDNAP_STEP)


def mapping(f: PoseFilter, recording: Recording, labelled: bool) -> Figures:
    """Start known, map unknown."""
    f.reset(recording.start, np.diag(START_SIGMA**2))
    errors, nees, elapsed, health = [], [], 0.0, Health()
    for step in recording.steps:
        observations = observed(step, recording.scene, f.landmarks() if labelled else None)
        begun = time.process_time()
        f.predict(step.motion)
        f.update(observations)
        pose, cov, depletion = f.estimate()
        elapsed += time.process_time() - begun
        health.add(depletion)
        off = pose[:2] - step.truth[:2]
        errors.append(float(np.hypot(*off)))
        nees.append(mahalanobis2(off, cov[:2, :2]))
    out: Figures = {
        "position_rms_m": rms(errors),
        "position_mean_m": float(np.mean(errors)),
        "position_max_m": float(np.max(errors)),
        "position_end_m": errors[-1],
        "position_nees_mean": float(np.mean(nees)),
        "position_nees": [round(x, 4) for x in nees[::KEEP_EVERY]],
        "us_per_step": 1e6 * elapsed / len(recording.steps),
    }
    out |= health.figures(f)
    return out | (_map_figures(f.landmarks(), recording.scene) if labelled else {})


def _map_figures(m: Landmarks, scene: Scene) -> Figures:
    """Errors of the map at the end; kinds are identities, and of landmarks that are there twice the first counts."""
    first = np.unique(m.crossing_type, return_index=True)[1]
    twice = len(m) - len(first)
    m = Landmarks(m.ids[first], m.xy_map_m[first], m.cov_m2[first], m.crossing_type[first], m.sightings[first])
    off = m.xy_map_m - scene.xy_m[m.crossing_type]
    error = np.hypot(*off.T)
    nees = [mahalanobis2(o, c) for o, c in zip(off, m.cov_m2, strict=True)]
    return {
        "feature_rms_m": rms(error),
        "feature_mean_m": float(np.mean(error)) if len(m) else float("nan"),
        "feature_max_m": float(np.max(error, initial=0.0)),
        "feature_nees_mean": float(np.mean(nees)) if len(m) else float("nan"),
        "features": float(len(m)),
        "features_twice": float(twice),
    }


def on_a_map(f: PoseFilter, recording: Recording, anywhere: bool) -> Figures:
    """Map known: when does the pose come right, and was it called TRACKING while it was wrong?"""
    scene = recording.scene
    cov = np.full((3, 3), np.inf) if anywhere else np.diag(START_SIGMA**2)
    start = np.zeros(3) if anywhere else recording.start
    f.reset(start, cov, known_map(scene.xy_m, scene.kind), known=True)
    machine, errors, claimed, health = StateMachine(States()), [], [], Health()
    for i, step in enumerate(recording.steps):
        f.predict(step.motion)
        f.update(observed(step, scene, None))
        errors.append(float(np.hypot(*(f.estimate()[0] - step.truth)[:2])))
        health.add(f.estimate()[2])
        claimed.append(machine.step(evidence(f, i, len(step.seen))).state is State.TRACKING)
    begin = max(recording.kidnapped, 0)
    wrong = np.array(errors) > LOST_M
    last_wrong = np.flatnonzero(wrong[begin:])
    time_s = 0.0 if not len(last_wrong) else (last_wrong[-1] + 1) * DT_S
    return {
        "recovered_s": float(time_s) if not wrong[-1] else float("inf"),
        "wrong_tracking_s": DT_S * longest(wrong & np.array(claimed)),
        "tracking_share": float(np.mean(claimed)),
        "position_end_m": errors[-1],
        "lost_before": float(np.any(wrong[:begin])),
    } | health.figures(f)


class Health:
    """What a filter says of itself with every estimate, averaged over a run."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []

    def add(self, d: FilterHealth) -> None:
        low, high = chi_square_bounds(d.nis_dof)
        inside = float(low <= d.nis <= high) if d.nis_dof else float("nan")
        nis = d.nis if d.nis_dof else float("nan")
        kept = float("nan") if d.unique_ancestors is None else d.unique_ancestors / d.particles
        self._rows.append((d.ess / d.particles, kept, d.fit_residual, nis, inside, d.mode_weight))

    def figures(self, f: PoseFilter) -> Figures:
        """Shares of the particles that are effective and that have descendants, NIS and how often its bounds hold."""
        names = ("ess_share", "ancestors_share", "fit_residual", "nis", "nis_in_bounds", "mode_weight")
        rows = np.array(self._rows)
        known = {n: column[np.isfinite(column)] for n, column in zip(names, rows.T, strict=True)}
        out: Figures = {f"health_{n}": float(np.mean(v)) for n, v in known.items() if len(v)}
        return out | {f"count_{n}": float(v) for n, v in f.counters().items()}


def evidence(f: PoseFilter, step: int, seen: int) -> Evidence:
    """What the pipeline would tell the state machine; wheels and vision always give a motion here."""
    _, cov, d = f.estimate()
    return Evidence(
        stamp_ns=round((step + 1) * DT_S * 1e9),
        motion_ok=True,
        failure="",
        inliers=seen,
        crossings=seen,
        position_sigma_m=float(np.sqrt(max(np.linalg.eigvalsh(cov[:2, :2])[-1], 0.0))),
        heading_sigma_rad=float(np.sqrt(max(cov[2, 2], 0.0))),
        nis=d.nis,
        nis_dof=d.nis_dof,
        ess_ratio=d.ess / d.particles,
        landmarks_matched=d.nis_dof // 2,
        in_doubt="searching" if d.mode_weight < SURE else "",
    )


def observed(step: Step, scene: Scene, landmarks: Landmarks | None) -> Observations:
    """What the filter is shown: labelled by identity among the landmarks it has, or left to it where None."""
    label = np.full(len(step.seen), UNLABELLED, np.int64)
    if landmarks is not None:
        label = labels_of(scene.kind[step.seen], landmarks)
    return Observations(
        step.xy_base_m,
        np.repeat(step.sigma_m[:, None] ** 2, 2, axis=1),
        scene.kind[step.seen],
        label,
        step.heading_rad,
        step.heading_sigma_rad**2,
    )


def labels_of(identity: Ints, landmarks: Landmarks) -> Ints:
    """Index of the landmark whose kind is the identity, NO_LANDMARK where it is not mapped yet."""
    index = {int(k): i for i, k in reversed(list(enumerate(landmarks.crossing_type)))}
    return np.array([index.get(int(k), NO_LANDMARK) for k in identity], np.int64)


def known_map(xy_m: Array, kind: Ints, sigma_m: float = 1e-3) -> Landmarks:
    count = len(kind)
    return Landmarks(
        np.arange(count, dtype=np.int64),
        xy_m,
        np.tile(sigma_m**2 * np.eye(2), (count, 1, 1)),
        kind,
        np.full(count, 100, np.int64),
    )


def mahalanobis2(off: Array, cov: Array) -> float:
    """off' cov^-1 off, infinite where the covariance is singular."""
    try:
        return float(off @ np.linalg.solve(cov, off))
    except np.linalg.LinAlgError:
        return float("inf")


def rms(values: Array | list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def longest(flags: Array | list[bool]) -> int:
    """Length of the longest run of true values."""
    best = now = 0
    for flag in flags:
        now = now + 1 if flag else 0
        best = max(best, now)
    return best


def as_key(cell: Cell) -> dict[str, str | int]:
    return asdict(cell)
