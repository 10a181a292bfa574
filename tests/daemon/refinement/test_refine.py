"""Refined maps against the ceiling that they were made from; the calibration in use is off by what a site has."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from ceilvo.bench.refine.building import WRONG, Drive, Hall, error, floor, views
from ceilvo.calibration import Calibration
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.refinement.calibration_field import CalibrationField, corrected
from ceilvo.daemon.refinement.refine import refine
from ceilvo.daemon.refinement.straightness import rows_of
from ceilvo.daemon.refinement.survey import Anchors, Floor, Survey, survey_of
from ceilvo.types import Landmarks

HALL = Hall(0.0, 0.0, 12.0, 9.0)
TAPE_SIGMA_M = 1e-3


@lru_cache
def driven(seed: int = 1) -> tuple[Drive, list[KeyPoses], Landmarks]:
    drive = floor((HALL,), 0.6, seed, 3)
    return drive, *views(drive, seed + 100)


def on_one_floor(sessions: Sequence[KeyPoses], landmarks: Landmarks, calibration: Calibration) -> Survey:
    return survey_of([Floor(landmarks, 0.0, tuple(sessions))], [calibration])


def surveyed(seed: int = 1) -> tuple[Drive, Survey]:
    drive, sessions, landmarks = driven(seed)
    return drive, on_one_floor(sessions, landmarks, drive.wrong)


def tape(drive: Drive, survey: Survey) -> Anchors:
    ends = np.array([[int(np.argmin(survey.xy_m.sum(axis=1))), int(np.argmax(survey.xy_m.sum(axis=1)))]])
    a, b = drive.xy_m[survey.ids[ends[0]]]
    return Anchors(ends, np.array([np.hypot(*(a - b))]), np.array([TAPE_SIGMA_M]))


@pytest.mark.parametrize("seed", [1, 2])
def test_a_map_that_a_wrong_calibration_bent_is_straightened(seed: int) -> None:
    drive, survey = surveyed(seed)
    truth = drive.xy_m[survey.ids]
    before, done = error(survey.xy_m, truth), refine(survey, anchors=tape(drive, survey))
    after = error(done.estimate.xy_m, truth)
    print(f"seed {seed}: before {before}; after {after}")
    assert before.rms_mm > 15.0
    assert after.rms_mm < 1.0 and after.worst_mm < 3.0
    assert abs(after.scale_ppm) < 3e6 * TAPE_SIGMA_M / 14.0
    assert len(done.unexplained) == 0 and done.cost[1] < 0.2 * done.cost[0]


def test_the_calibration_is_found_within_what_it_claims() -> None:
    drive, survey = surveyed()
    done = refine(survey, anchors=tape(drive, survey))
    k1 = drive.calibration.camera.distortion[0]
    off = WRONG * np.array([1.0, 1.0, k1, 1.0, 1.0])
    left = done.estimate.correction[0] + off  # it takes back what is wrong, to first order
    sigma = np.hypot(done.correction_sigma[0], 0.02 * np.abs(off))
    print(f"left {left}, claimed {sigma}")
    assert np.all(np.abs(left) < 4.0 * sigma)


def test_without_a_tape_only_the_scale_stays_as_it_was() -> None:
    drive, survey = surveyed()
    done = refine(survey)
    xy, truth = done.estimate.xy_m, drive.xy_m[survey.ids]
    scale = 1.0 + 1e-6 * error(xy, truth).scale_ppm
    assert abs(scale - 1.0) < 4.0 * done.correction_sigma[0, 0]
    assert error(xy / scale, truth).rms_mm < 1.0


def test_covariances_cover_the_errors_between_neighbours() -> None:
    drive, survey = surveyed()
    done = refine(survey, anchors=tape(drive, survey))
    xy, truth = done.estimate.xy_m, drive.xy_m[survey.ids]
    off = xy - truth
    near = np.argsort(np.hypot(*(truth[:, None] - truth[None]).transpose(2, 0, 1)), axis=1)[:, :24]
    off = off - off[near].mean(axis=1)
    nees = np.einsum("li,lij,lj->l", off, np.linalg.inv(done.cov_m2), off)
    print(f"NEES {nees.mean():.2f}, expected 2")
    assert 1.0 < nees.mean() < 4.0


def test_wrong_names_do_not_bend_the_map() -> None:
    drive, sessions, landmarks = driven()
    rng = np.random.default_rng(5)
    mixed = []
    for s in sessions:
        name, wrong = s.landmark.copy(), rng.random(s.features) < 0.02
        name[wrong] = rng.choice(landmarks.ids, np.count_nonzero(wrong))
        mixed.append(replace(s, landmark=name))
    survey = on_one_floor(mixed, landmarks, drive.wrong)
    done = refine(survey, anchors=tape(drive, survey))
    after = error(done.estimate.xy_m, drive.xy_m[survey.ids])
    print(f"2 % wrong names: {after}; mean weight {done.weight.mean():.3f}")
    assert after.rms_mm < 1.0 and after.worst_mm < 5.0
    assert np.count_nonzero(done.weight < 0.1) > 0.015 * len(done.weight)


def test_a_gap_is_bridged_by_the_motion_over_it() -> None:
    """Views of 1.5 m in the middle of the only lane are gone: the two halves share no landmark."""
    drive = floor((Hall(0.0, 0.0, 14.0, 2.2),), 0.6, 4, 1, lane_m=9.0)
    lane = replace(drive, sessions=(drive.sessions[0][:48],))
    (whole,), landmarks = views(lane, 7)
    gone = (whole.pose[:, 0] > 5.0) & (whole.pose[:, 0] < 9.5)
    kept = np.flatnonzero(~gone[whole.view])
    blind = replace(
        whole,
        view=whole.view[kept],
        xy_base_m=whole.xy_base_m[kept],
        cov_base_m2=whole.cov_base_m2[kept],
        crossing_type=whole.crossing_type[kept],
        landmark=whole.landmark[kept],
    )
    survey = on_one_floor([blind], landmarks, lane.calibration)
    done = refine(replace(survey, calibrations=(lane.wrong,)))
    assert np.all(np.isfinite(done.estimate.pose))
    apart = done.estimate.pose[-1, 0] - done.estimate.pose[0, 0]
    assert abs(apart - (lane.sessions[0][-1, 0] - lane.sessions[0][0, 0])) < 0.1


def test_sessions_that_share_nothing_each_stay_where_they_are() -> None:
    drive, sessions, landmarks = driven()
    other = replace(
        sessions[1],
        session="far",
        pose=sessions[1].pose + np.array([100.0, 0.0, 0.0]),
        landmark=sessions[1].landmark + 10**6,
    )
    far = replace(landmarks, ids=landmarks.ids + 10**6, xy_map_m=landmarks.xy_map_m + np.array([100.0, 0.0]))
    both = Landmarks(
        *(np.concatenate([getattr(landmarks, k), getattr(far, k)]) for k in ("ids", "xy_map_m", "cov_m2")),
        np.tile(landmarks.crossing_type, 2),
        np.tile(landmarks.sightings, 2),
    )
    survey = on_one_floor([sessions[0], other], both, drive.wrong)
    done = refine(survey)
    starts = [0, len(sessions[0])]
    assert np.all(np.abs(done.estimate.pose[starts] - survey.pose[starts]) < 1e-3)


def test_two_marks_put_the_map_where_a_surveyor_has_it() -> None:
    drive, survey = surveyed()
    turn, shift = np.array([[0.6, -0.8], [0.8, 0.6]]), np.array([5.0, -3.0])
    truth = drive.xy_m[survey.ids] @ turn.T + shift
    start = replace(survey, xy_m=survey.xy_m @ turn.T + shift + 0.05, axis_rad=np.array([np.arctan2(0.8, 0.6)]))
    turned = np.column_stack([survey.pose[:, :2] @ turn.T + shift + 0.05, survey.pose[:, 2] + start.axis_rad])
    mark = tape(drive, survey).between[0]
    done = refine(
        replace(start, pose=turned), anchors=Anchors(mark=mark, mark_xy_m=truth[mark], mark_sigma_m=np.full(2, 1e-3))
    )
    off = np.hypot(*(done.estimate.xy_m - truth).T)
    print(f"off the surveyor's map by {1e3 * off.max():.2f} mm at most")
    assert off.max() < 5e-3


def test_no_landmark_seen_twice_is_said() -> None:
    drive, sessions, landmarks = driven()
    alone = replace(sessions[0], landmark=np.full(sessions[0].features, -1))
    with pytest.raises(ValueError, match="no landmark was seen from two key poses"):
        on_one_floor([alone], landmarks, drive.wrong)


def test_the_look_up_is_as_good_as_the_lens() -> None:
    drive, _ = surveyed()
    rng = np.random.default_rng(3)
    xy = rng.uniform(-1.0, 1.0, (200, 2))
    correction = np.array([0.004, -0.003, 0.01, 0.004, -0.005])
    placed, jacobian = CalibrationField(drive.wrong, xy).at(correction)
    exact = corrected(drive.wrong, correction)
    level = np.column_stack([xy, np.ones(len(xy))]) @ drive.wrong.level_from_ceiling.T
    raw = drive.wrong.level_view.to_raw(level[:, :2] / level[:, 2:])
    s = np.column_stack([exact.level_view.from_raw(raw), np.ones(len(xy))]) @ exact.ceiling_from_level.T
    assert np.max(np.abs(placed - s[:, :2] / s[:, 2:])) < 2e-5
    step = 1e-4 * np.array([1.0, -1.0, 1.0, 1.0, -1.0])
    after, _ = CalibrationField(drive.wrong, xy).at(correction + step)
    assert np.max(np.abs(after - placed - jacobian @ step)) < 1e-6


def test_rows_are_the_joints_of_the_grid() -> None:
    x, y = np.meshgrid(np.arange(5) * 0.6, np.arange(4) * 0.6, indexing="ij")
    xy = np.column_stack([x.ravel(), y.ravel()])
    turn = 0.3
    turned = xy @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    rows = rows_of(turned, turn, np.ones(len(xy), bool))
    assert np.count_nonzero(rows.axis == 0) == 5 * 3 and np.count_nonzero(rows.axis == 1) == 4 * 4
    for axis in (0, 1):
        off = np.abs(xy[rows.pair[rows.axis == axis, 0]] - xy[rows.pair[rows.axis == axis, 1]])
        assert np.allclose(off[:, axis], 0.0) and np.allclose(off[:, 1 - axis], 0.6)
