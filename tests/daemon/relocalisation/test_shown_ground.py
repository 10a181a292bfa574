"""What ground views showed, and that the index of places follows the map as far as the camera sees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from golden_drives import RATE_HZ, Drive, load

from ceilvo.config import Config
from ceilvo.crossing_types import CORNER
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.relocalisation.survey import MapSurvey
from ceilvo.daemon.slam.upkeep import inside
from ceilvo.se2 import inverse, transform
from ceilvo.types import Array, Crossings, Landmarks, Pose

FRAMES = 100
FAR_M = 6.0
"""Seen by a camera 6 m below the ceiling."""


@pytest.fixture(scope="module")
def lap() -> Drive:
    return load("lap", "joint")


def mapped(lap: Drive, **changed: bool) -> Pipeline:
    """After FRAMES of the lap, with other flags of its views."""
    pipeline = Pipeline(lap.calibration, lap.config, np.random.default_rng(1))
    for k in range(FRAMES):
        pipeline.step_crossings(10**9 + round(k * 1e9 / RATE_HZ), replace(lap.crossings[k], **changed), lap.wheels[k])
    return pipeline


def test_ground_is_known_under_a_slope_too(lap: Drive) -> None:
    """What is missing cannot be told there, so that views are not complete; doubts of the place were dropped then."""
    level, sloping = mapped(lap), mapped(lap, complete=False)
    known = sloping.relocaliser.state.survey.coverage
    landmarks = sloping.landmarks()
    often = landmarks.xy_map_m[landmarks.sightings > 30]
    assert len(often) > 20
    assert np.mean(known.knows(often)) > 0.9
    assert known.area_m2 < level.relocaliser.state.survey.coverage.area_m2
    sloping.relocaliser.suspect("somebody carried it", 1.0)
    assert not sloping.relocaliser.sure


def test_a_view_of_which_only_some_heights_are_known_shows_no_ground(lap: Drive) -> None:
    """What it left out would seem to be new there later."""
    assert mapped(lap, complete=False, several=True).relocaliser.state.survey.coverage.area_m2 == 0.0


def test_what_is_seen_at_the_rim_from_two_spots_is_looked_at_twice(lap: Drive) -> None:
    """It counted as new at every spot: one corner by another name raised a wrong place by e^9 in six of them."""
    pipeline = mapped(lap)
    relocaliser, again, rim = pipeline.relocaliser, 0, 0
    state, at_m = relocaliser.state, np.empty((0, 2))
    for k in range(FRAMES, len(lap.crossings)):
        spots, shown_m = state.spots, state.spot_m
        pipeline.step_crossings(10**9 + round(k * 1e9 / RATE_HZ), lap.crossings[k], lap.wheels[k])
        if state.spot_m is shown_m:
            continue
        view = relocaliser._sharp.of(relocaliser.observed(relocaliser.tells(lap.crossings[k])))
        xy_m = transform(relocaliser.filter.estimate()[0], view.xy_base_m)
        if state.spots == spots + 1:
            seen = np.any(np.hypot(*(xy_m[:, None] - at_m).T).T < 0.03, axis=1)
            assert np.all(relocaliser._worth(view)[seen] <= 0.5)
            again += int(np.count_nonzero(seen))
            rim += int(np.count_nonzero(seen & ~inside(relocaliser._sharp.visible_m, view.xy_base_m)))
        at_m = xy_m
    print(f"{again} seen again from the next spot, {rim} of them at the rim")
    assert rim > 20


def with_corners(seen: Crossings, lines: int, corners_m: Array, pose: Array) -> Crossings:
    """The same view with so many crossings of lines, and corners (N, 2) in map around a pose (3,)."""
    xy = transform(Pose(inverse(pose)), corners_m)
    xy = xy[np.hypot(*xy.T) < 1.0]
    n, seen = len(xy), seen.of(np.argsort(np.hypot(*seen.xy_base_m.T))[:lines])
    at = np.column_stack([seen.xy_base_m, np.ones(len(seen))])
    uv = np.column_stack([xy, np.ones(n)]) @ np.linalg.lstsq(at, seen.uv_px, rcond=None)[0]
    return replace(
        seen,
        uv_px=np.concatenate([seen.uv_px, uv]),
        xy_base_m=np.concatenate([seen.xy_base_m, xy]),
        cov_base_m2=np.concatenate([seen.cov_base_m2, np.tile(1e-6 * np.eye(2), (n, 1, 1))]),
        crossing_type=np.concatenate([seen.crossing_type, np.full(n, CORNER)]),
        complete=False,
    )


def test_points_that_are_looked_for_from_now_on_do_not_contradict_ground_that_was_seen_for_its_lines(
    lap: Drive,
) -> None:
    """Under hexagons a robot was RELOCALISING, .3 mm off, from when lines no longer sufficed, and learnt no corner."""
    plain = mapped(lap)
    where = plain.filter.estimate()[0]
    corners = where[:2] + np.random.default_rng(11).uniform(-1.2, 1.2, (40, 2))
    pipeline, sure = mapped(lap), []
    for k in range(FRAMES, FRAMES + 40):
        stamp = 10**9 + round(k * 1e9 / RATE_HZ)
        plain.step_crossings(stamp, lap.crossings[k], lap.wheels[k])
        lines = 5 if k > FRAMES else len(lap.crossings[k])
        seen = with_corners(lap.crossings[k], lines, corners, plain.filter.estimate()[0])
        pipeline.step_crossings(stamp, seen, lap.wheels[k])
        sure.append(pipeline.relocaliser.sure)
    learnt = np.count_nonzero(pipeline.landmarks().crossing_type == CORNER)
    print(f"sure in {sum(sure)} of {len(sure)} views, {learnt} corners learnt")
    assert all(sure) and learnt >= 20


def test_the_index_follows_the_map_as_far_as_the_camera_sees() -> None:
    filter_, pose, survey = (
        make_filter(Config().filter, np.random.default_rng(1)),
        np.array([3.0, -2.0, 0.4]),
        MapSurvey(),
    )
    at = transform(Pose(pose), np.random.default_rng(2).uniform(-0.9 * FAR_M, 0.9 * FAR_M, (80, 2)))
    n = len(at)
    ones = np.full(n, 20)
    landmarks = Landmarks(np.arange(n), at, np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.full(n, 4), ones)
    square = FAR_M * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    for kept in (np.arange(n), np.arange(0, n, 2)):
        filter_.reset(pose, 1e-6 * np.eye(3), landmarks.of(kept))
        survey.learnt(filter_, square, landmarks.crossing_type)
        found = survey.index.within(pose[:2] - 2.0 * FAR_M, pose[:2] + 2.0 * FAR_M)
        assert sorted(found.tolist()) == sorted(landmarks.ids[kept].tolist())
