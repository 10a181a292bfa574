"""The same problem solved by GTSAM, which shares no line with ours; skipped where it is not installed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ceilvo.bench.refine.building import Hall, floor, laid_on, views
from ceilvo.daemon.refinement.calibration_field import CalibrationPrior
from ceilvo.daemon.refinement.equations import HELD_SIGMA, ROBUST
from ceilvo.daemon.refinement.refine import refine
from ceilvo.daemon.refinement.survey import Floor, Survey, survey_of
from ceilvo.types import NO_DIRECTION_RAD, Array

gtsam = pytest.importorskip("gtsam", reason="gtsam is not installed; pip install gtsam to compare with it")
EXACT = CalibrationPrior(height=1e-9, focal=1e-9, k1=1e-9, k1_least=1e-9, tilt_deg=1e-9)
POSE, LANDMARK = "x", "l"


def seen(key: tuple[int, int], measured: Array, w: Array) -> Any:
    """A feature (2,) in base with the square root of its information, under Cauchy's loss."""
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(ROBUST), gtsam.noiseModel.Gaussian.SqrtInformation(w)
    )

    def off(this: Any, values: Any, jacobians: list[Array] | None) -> Array:
        pose, point = values.atPose2(key[0]), values.atPoint2(key[1])
        by_pose, by_point = np.zeros((2, 3), order="F"), np.zeros((2, 2), order="F")
        base = pose.transformTo(point, by_pose, by_point)
        if jacobians is not None:
            jacobians[0], jacobians[1] = by_pose, by_point
        return np.asarray(base - measured)

    return gtsam.CustomFactor(noise, list(key), off)


def by_gtsam(s: Survey) -> Array:
    """(L, 2) landmarks."""
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, pose in enumerate(s.pose):
        start.insert(gtsam.symbol(POSE, k), gtsam.Pose2(*pose))
    for i, xy in enumerate(s.xy_m):
        start.insert(gtsam.symbol(LANDMARK, i), xy)
    held = gtsam.noiseModel.Diagonal.Sigmas(HELD_SIGMA)
    graph.add(gtsam.PriorFactorPose2(gtsam.symbol(POSE, 0), gtsam.Pose2(*s.pose[0]), held))
    for view, landmark, xy, w in zip(s.view, s.landmark, s.seen_m, s.root_info, strict=True):
        graph.add(seen((gtsam.symbol(POSE, int(view)), gtsam.symbol(LANDMARK, int(landmark))), xy, w))
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-9)
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, settings).optimize()
    return np.array([found.atPoint2(gtsam.symbol(LANDMARK, i)) for i in range(len(s.xy_m))])


def test_gtsam_finds_the_same_map() -> None:
    drive = floor((Hall(0.0, 0.0, 6.0, 5.0),), 0.6, 3, 1)
    sessions, landmarks = views(replace(drive, wrong=drive.calibration), 103)
    none = [replace(s, direction_sigma_rad=np.full(len(s), NO_DIRECTION_RAD)) for s in sessions]
    survey = survey_of([Floor(landmarks, 0.0, tuple(none))], [drive.calibration])
    rng = np.random.default_rng(4)
    often = np.bincount(survey.landmark)[survey.landmark] >= 5  # of two views nobody knows which one is wrong
    wrong = often & (rng.random(len(survey.seen_m)) < 0.02)
    survey = replace(survey, seen_m=survey.seen_m + wrong[:, None] * rng.normal(0.0, 0.05, survey.seen_m.shape))
    own = refine(survey, prior=EXACT, straight=False).estimate.xy_m
    theirs = by_gtsam(replace(survey, xy_m=own + rng.normal(0.0, 1e-3, own.shape)))
    apart = np.hypot(*(own - theirs).T)
    moved = np.hypot(*(laid_on(own, survey.xy_m) - survey.xy_m).T)
    print(
        f"{len(survey.pose)} poses: apart {1e6 * apart.max():.1f} um at most; the map moved {1e3 * moved.max():.1f} mm"
    )
    assert apart.max() < 2e-5 and moved.max() > 1e-3
