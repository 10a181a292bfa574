"""python -m ceilvo.bench.refine.localise: a robot drives 100 m on a map that was refined. How far off is it, and does
that grow with the way?

The daemon drives through a hall several times with a calibration that is off, its map is refined with a tape, and a
robot with the corrected calibration drives another way on it.
Example: python -m ceilvo.bench.refine.localise --seed 1000
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ceilvo import se2
from ceilvo.bench.place.ceiling.eye import SyntheticEye
from ceilvo.bench.place.ceiling.truth import Features
from ceilvo.bench.refine.building import WRONG
from ceilvo.bench.refine.study import Room, error_of, localised, mapped, onto_truth, room
from ceilvo.config import Config
from ceilvo.crossing_types import JOINTS
from ceilvo.daemon.refinement.calibration_field import corrected
from ceilvo.daemon.refinement.measured import Measured, Tape
from ceilvo.daemon.refinement.sessions import refined_map
from ceilvo.daemon.refinement.survey import Floor
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array, Estimate, Landmarks, State

TAPE_SIGMA_M = 2e-3
"""Of a laser from one wall to the other."""
PARTS = 5
"""Of the way, whose errors are told one by one."""


def main(arguments: Sequence[str] | None = None) -> int:
    """0; the figures are for people."""
    parser = argparse.ArgumentParser(prog="python -m ceilvo.bench.refine.localise", description=__doc__)
    parser.add_argument("--seed", type=int, default=1000, help="0 to 999 for tuning, 1000 and more for figures")
    parser.add_argument("--room", choices=("5", "20", "60"), default="20")
    parser.add_argument("--sessions", type=int, default=3)
    parser.add_argument("--mapped-m", type=float, default=120.0, help="way of each session that maps")
    parser.add_argument("--length-m", type=float, default=100.0, help="way on the refined map")
    parser.add_argument("--png", type=Path, default=Path("build/bench/localise.png"))
    a = parser.parse_args(arguments)
    true = simulated_calibration()
    off = WRONG * np.array([1.0, 1.0, true.camera.distortion[0], 0.0, 0.0])  # the finder estimates the tilt itself
    believed, hall = corrected(true, off), room(a.room, 0.6, a.seed, a.sessions, a.mapped_m)
    sessions, landmarks, axis = mapped(hall, believed, Config(), a.seed + 1, lambda said: print(said, flush=True))
    print("joints before: {}; {} landmarks are of no crossing".format(*error_of(*_joints(landmarks, hall.features))))
    tape = Measured((_tape(landmarks, hall.features, sorted({int(i) for s in sessions for i in s.landmark})),))
    done = refined_map([Floor(landmarks, axis, tuple(sessions))], [believed], measured=tape)
    after = done.floors[0]
    print(
        "joints after:  {}; {} landmarks are of no crossing".format(*error_of(*_joints(after.landmarks, hall.features)))
    )
    print(
        f"calibration after: focal {done.last.calibrations[0].camera.focal_px:.2f} px, truth {true.camera.focal_px:.2f}"
    )
    way = _cut(room(a.room, 0.6, a.seed, 1, a.length_m), a.length_m)
    truth_from_map = onto_truth(*_joints(after.landmarks, hall.features))[0]
    runs = {
        "refined map, corrected calibration": (after.landmarks, after.axis_rad, done.last.calibrations[0]),
        "map as it was, old calibration": (landmarks, axis, believed),
    }
    told: dict[str, tuple[Array, Array]] = {}
    for name, (known, direction, calibration) in runs.items():
        laid = truth_from_map if known is after.landmarks else onto_truth(*_joints(known, hall.features))[0]
        eye = SyntheticEye(hall.features, true, np.random.default_rng([a.seed, 2]))
        rng = np.random.default_rng([a.seed, 3])
        estimates = localised(eye, way, known, direction, laid, calibration, Config(), rng)
        along, error = _errors(estimates, way, laid)
        told[name] = along, error
        print(f"{name}: {_said(along, error, estimates)}", flush=True)
    a.png.parent.mkdir(parents=True, exist_ok=True)
    plot(told, a.png)
    print(f"{a.png}: plot written")
    return 0


def _joints(landmarks: Landmarks, features: Features) -> tuple[Landmarks, Array]:
    """Joints only, which are a tile apart: what is nearest to a corner of a vent may be its next slat."""
    own = landmarks.of(np.flatnonzero(landmarks.crossing_type == JOINTS))
    return own, features.xy_map_m[features.crossing_type == JOINTS]


def _tape(landmarks: Landmarks, features: Features, seen: list[int]) -> Tape:
    """Between those joints of sessions that are farthest apart along a diagonal."""
    landmarks, truth_m = _joints(landmarks, features)
    _, used, nearest = onto_truth(landmarks, truth_m)
    good = used & np.isin(landmarks.ids, seen) & (landmarks.sightings > np.median(landmarks.sightings))
    which = np.flatnonzero(good)
    along = landmarks.xy_map_m[which].sum(axis=1)
    i, j = int(which[np.argmin(along)]), int(which[np.argmax(along)])
    length = float(np.hypot(*(truth_m[nearest[i]] - truth_m[nearest[j]])))
    print(f"a tape of {length:.3f} m")
    return Tape(0, (int(landmarks.ids[i]), int(landmarks.ids[j])), length, TAPE_SIGMA_M)


def _cut(hall: Room, length_m: float) -> Array:
    """The first so many metres of the only way, (K, 3)."""
    way = hall.ways[0]
    return way[: int(np.searchsorted(_along(way), length_m))]


def _along(way: Array) -> Array:
    """(K,) m driven."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way[:, :2], axis=0).T))])


def _errors(estimates: Sequence[Estimate], way: Array, truth_from_map: Array) -> tuple[Array, Array]:
    """(K,) way driven, and (K, 3) errors across x, y (m) and heading (rad)."""
    poses = np.asarray(se2.compose(truth_from_map, np.array([e.pose for e in estimates])))
    off = poses - way
    off[:, 2] = se2.wrap_array(off[:, 2])
    return _along(way), off


def _said(along: Array, off: Array, estimates: Sequence[Estimate]) -> str:
    length, states = 1e3 * np.hypot(off[:, 0], off[:, 1]), Counter(State(e.state).name for e in estimates)
    rms = [np.sqrt(np.mean(part**2)) for part in np.array_split(length, PARTS)]
    slope = np.polyfit(along, length, 1)[0]
    return (
        f"{along[-1]:.1f} m, {np.sqrt(np.mean(length**2)):.2f} mm rms, {length.max():.2f} mm at most, heading "
        f"{1e3 * np.sqrt(np.mean(off[:, 2] ** 2)):.2f} mrad rms; by fifths {', '.join(f'{r:.2f}' for r in rms)} mm; "
        f"{1e3 * slope:+.1f} um a metre; {dict(states)}"
    )


def plot(told: dict[str, tuple[Array, Array]], path: Path) -> None:
    """Error against distance; needs matplotlib (the bench extra)."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 1, figsize=(9, 6), sharex=True, layout="constrained")
    for name, (along, off) in told.items():
        axes[0].plot(along, 1e3 * np.hypot(off[:, 0], off[:, 1]), linewidth=0.8, label=name)
        axes[1].plot(along, 1e3 * off[:, 2], linewidth=0.8)
    axes[0].axhline(3.0, color="k", linewidth=0.5, linestyle="--")
    axes[0].set_ylabel("place off (mm)")
    axes[0].legend(loc="upper right")
    axes[1].set_ylabel("heading off (mrad)")
    axes[1].set_xlabel("way (m)")
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    raise SystemExit(main())
