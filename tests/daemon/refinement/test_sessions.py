"""From the daemon's own drive to a refined map: key poses are taken, named, refined and named again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceilvo.bench.refine.building import WRONG
from ceilvo.bench.refine.study import error_of, mapped, room
from ceilvo.config import Config
from ceilvo.daemon.refinement.calibration_field import corrected
from ceilvo.daemon.refinement.names import united
from ceilvo.daemon.refinement.sessions import refined_map
from ceilvo.daemon.refinement.survey import Floor
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Landmarks, LineKind

SEED = 7
GRID = 3 * (LineKind.GROOVE + 1) + LineKind.GROOVE + 1
"""Where joints of tiles cross; of other crossings there are several close together."""


def test_two_drives_of_the_daemon_become_one_straight_map() -> None:
    true = simulated_calibration()
    believed = corrected(true, WRONG * np.array([0.0, 1.0, true.camera.distortion[0], 0.0, 0.0]))
    hall = room("5", 0.6, SEED, 2, 16.0)
    sessions, landmarks, axis_rad = mapped(hall, believed, Config(), SEED + 1, lambda said: None)
    before = error_of(landmarks.of(landmarks.crossing_type == GRID), hall.features.xy_map_m)[0]
    done = refined_map([Floor(landmarks, axis_rad, tuple(sessions))], [believed])
    (floor,) = done.floors
    after, alone = error_of(floor.landmarks.of(floor.landmarks.crossing_type == GRID), hall.features.xy_map_m)
    print(f"seed {SEED}: {[len(s) for s in sessions]} key poses; before {before}; after {after}; {alone} alone")
    assert [s.session for s in floor.sessions] == ["simulated/0", "simulated/1"]
    assert min(len(s) for s in sessions) > 25
    assert done.features[1] > 0.9 * done.features[0]
    unknown_ppm = 1e6 * float(np.hypot(*done.last.correction_sigma[0, :2]))  # nobody measured a length
    assert abs(after.scale_ppm) < 3.0 * unknown_ppm
    assert alone == 0 and after.worst_mm < 3.0 + 3e-3 * abs(after.scale_ppm)  # 3 m from the middle of the map


def test_one_landmark_with_two_names_becomes_one_and_two_that_are_seen_together_stay() -> None:
    true = simulated_calibration()
    hall = room("5", 0.6, SEED, 1, 12.0)
    (session,), landmarks, _ = mapped(hall, true, Config(), SEED + 1, lambda said: None)
    half = session.landmark.copy()
    late = session.view > len(session) // 2
    twice = int(np.bincount(session.landmark[session.landmark >= 0]).argmax())
    half[late & (half == twice)] = 10**6
    at = int(np.flatnonzero(landmarks.ids == twice)[0])
    both = Landmarks(
        np.append(landmarks.ids, 10**6),
        np.vstack([landmarks.xy_map_m, landmarks.xy_map_m[at] + 0.03]),
        np.concatenate([landmarks.cov_m2, landmarks.cov_m2[at : at + 1]]),
        np.append(landmarks.crossing_type, landmarks.crossing_type[at]),
        np.append(landmarks.sightings, 3),
    )
    plain, _ = united(landmarks, [session])
    one, now = united(both, [replace(session, landmark=half)])
    assert len(one) == len(plain) and now[-1] == now[at] != 10**6
    views = np.unique(session.view[session.landmark == twice])
    n = len(views)
    doubled = replace(
        session,
        view=np.append(session.view, views),
        xy_base_m=np.vstack([session.xy_base_m, np.zeros((n, 2))]),
        cov_base_m2=np.concatenate([session.cov_base_m2, np.tile(np.eye(2), (n, 1, 1))]),
        crossing_type=np.append(session.crossing_type, np.zeros(n, np.int64)),
        landmark=np.append(session.landmark, np.full(n, 10**6)),
    )
    apart, _ = united(both, [doubled])
    assert len(apart) == len(plain) + 1
