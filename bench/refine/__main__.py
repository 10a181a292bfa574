"""python -m ceilvo.bench.refine: a building's map before and after refinement, with the time and memory that it takes.

Views are made from a known ceiling and placed by a calibration that is off; names are the true ones, so what is
measured is the least squares alone. With --room the daemon drives and names landmarks itself.
Example: python -m ceilvo.bench.refine --halls 3
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np

from ceilvo.bench.refine.building import WRONG, Hall, error, floor, views
from ceilvo.bench.refine.study import error_of, mapped, room
from ceilvo.config import Config
from ceilvo.daemon.refinement.calibration_field import corrected
from ceilvo.daemon.refinement.refine import refine
from ceilvo.daemon.refinement.sessions import refined_map
from ceilvo.daemon.refinement.survey import Anchors, Floor, survey_of
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array

HALLS = (
    Hall(0.0, 0.0, 40.0, 30.0),
    Hall(40.0, 0.0, 10.0, 3.0),
    Hall(50.0, 0.0, 40.0, 30.0),
    Hall(50.0, 30.0, 3.0, 10.0),
    Hall(50.0, 40.0, 40.0, 30.0),
    Hall(40.0, 40.0, 10.0, 3.0),
    Hall(0.0, 40.0, 40.0, 30.0),
)
"""Four halls of 40 m x 30 m and corridors."""
TAPE_SIGMA_M = 2e-3
"""Of a laser that measures from one end of the building to the other."""


def main() -> int:
    parser = argparse.ArgumentParser(prog="refine", description=__doc__)
    parser.add_argument("--halls", type=int, default=len(HALLS), help="how many of the seven, corridors included")
    parser.add_argument("--floors", type=int, default=1, help="alike, but for the drives; the tape is on the first")
    parser.add_argument("--tile-m", type=float, default=0.6, help="side of a tile")
    parser.add_argument("--sessions", type=int, default=3, help="on each floor")
    parser.add_argument("--step-m", type=float, default=0.25, help="way between key poses")
    parser.add_argument("--lane-m", type=float, default=4.0, help="way between lanes")
    parser.add_argument("--seed", type=int, default=1000, help="0 to 999 for tuning, 1000 and more for figures")
    parser.add_argument("--no-tape", action="store_true", help="nobody measured a distance")
    parser.add_argument("--room", choices=("5", "20", "60"), help="a hall instead, by the daemon's steps")
    parser.add_argument("--length-m", type=float, default=120.0, help="way of a session in that hall")
    a = parser.parse_args()
    return _room(a) if a.room else _building(a)


def _room(a: argparse.Namespace) -> int:
    """The daemon drives through a hall, names landmarks itself, and the map is refined."""
    true = simulated_calibration()
    off = WRONG * np.array([1.0, 1.0, true.camera.distortion[0], 0.0, 0.0])  # the finder estimates the tilt itself
    believed, hall = corrected(true, off), room(a.room, 0.6, a.seed, a.sessions, a.length_m)
    sessions, landmarks, axis_rad = mapped(hall, believed, Config(), a.seed + 1, lambda said: print(said, flush=True))
    print("before: {}; {} landmarks are of no crossing".format(*error_of(landmarks, hall.features.xy_map_m)))
    done = refined_map([Floor(landmarks, axis_rad, tuple(sessions))], [believed])
    print(
        "after:  {}; {} landmarks are of no crossing".format(
            *error_of(done.floors[0].landmarks, hall.features.xy_map_m)
        )
    )
    twice, (shown, explained) = len(landmarks) - len(done.floors[0].landmarks), done.features
    print(f"{twice} landmarks had two names; {explained} of {shown} features are explained")
    print(f"correction {np.round(done.last.estimate.correction, 6)} +- {np.round(done.last.correction_sigma, 6)}")
    return 0


def _building(a: argparse.Namespace) -> int:
    drives = [
        floor(HALLS[: a.halls], a.tile_m, a.seed + 50 * k, a.sessions, a.step_m, a.lane_m) for k in range(a.floors)
    ]
    seen = [views(d, a.seed + 50 * k + 1) for k, d in enumerate(drives)]
    survey = survey_of([Floor(landmarks, 0.0, tuple(s)) for s, landmarks in seen], [drives[0].wrong])
    print(f"{len(survey.xy_m)} landmarks, {len(survey.pose)} key poses, {len(survey.view)} features")
    own = [survey.landmark_floor == k for k in range(a.floors)]
    truth = [d.xy_m[survey.ids[f]] for d, f in zip(drives, own, strict=True)]
    for f, true in zip(own, truth, strict=True):
        print(f"before: {error(survey.xy_m[f], true)}")
    anchors = None if a.no_tape else _tape(survey.xy_m[own[0]], truth[0])
    began, cpu_s = time.monotonic(), time.process_time()
    done = refine(survey, anchors=anchors, on_round=lambda k, cost: print(f"round {k}: cost {cost:.0f}", flush=True))
    took_s, cpu_s = time.monotonic() - began, time.process_time() - cpu_s
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    for f, true in zip(own, truth, strict=True):
        print(f"after:  {error(done.estimate.xy_m[f], true)}")
    print(f"{took_s:.0f} s, {cpu_s:.0f} s of the processor; at most {peak_gb:.2f} GB")
    print(f"correction {np.round(done.estimate.correction, 6)} +- {np.round(done.correction_sigma, 6)}")
    return 0


def _tape(xy_m: Array, truth_m: Array) -> Anchors:
    """From one end of the first floor to the other."""
    ends = np.array([[int(np.argmin(xy_m.sum(axis=1))), int(np.argmax(xy_m.sum(axis=1)))]])
    length = float(np.hypot(*(truth_m[ends[0, 0]] - truth_m[ends[0, 1]])))
    print(f"a tape of {length:.3f} m")
    return Anchors(ends, np.array([length]), np.array([TAPE_SIGMA_M]))


if __name__ == "__main__":
    raise SystemExit(main())
