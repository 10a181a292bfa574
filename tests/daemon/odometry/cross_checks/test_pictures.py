"""Old pictures are known by their noise: rendered frames of a camera that stands, drives, freezes or repeats itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from ceilvo.config import Config
from ceilvo.daemon.odometry.cross_checks.pictures import Pictures
from ceilvo.daemon.odometry.cross_checks.suspicion import Kind, Severity
from ceilvo.daemon.odometry.visual_odometry import VisualOdometry
from ceilvo.daemon.vision.finder.crossing_finder import CrossingFinder
from ceilvo.sim.motion import LapSpec
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Crossings, Frame

RATE_HZ = 30.0
STANDS, DRIVES = 12, 16
"""Frames of the drive: it stands first."""
Pictures_ = Sequence[np.ndarray]


@lru_cache(maxsize=4)
def world(noise: float) -> World:
    render = RenderSpec(read_noise=1.2 * noise, shot_noise=0.02 * noise**2)
    lap = LapSpec(room_m=4.0, rest_s=STANDS / RATE_HZ, ramp_s=0.5)
    return World(WorldSpec(seed=31, lap=lap, render=render))


@lru_cache(maxsize=4)
def drive(noise: float) -> Pictures_:
    """A stand, then a drive."""
    return [world(noise).frame_at(k / RATE_HZ) for k in range(STANDS + DRIVES)]


@lru_cache(maxsize=4)
def stand(noise: float) -> Pictures_:
    """The end of that drive, seen for a while."""
    still, w = (STANDS + DRIVES - 1) / RATE_HZ, world(noise)
    poses = [w.truth_at(still)] * 12
    return [w.renderer.render(pose, np.random.default_rng([7, k])) for k, pose in enumerate(poses)]


def crossings_of(frames: Sequence[np.ndarray], noise: float) -> list[Crossings]:
    """As vision finds them in frames that follow each other."""
    finder, odometry = CrossingFinder(world(noise).calibration, Config().features), VisualOdometry(Config().odometry)
    out = []
    for k, gray in enumerate(frames):
        crossings = finder(Frame(k, k, gray), odometry.expected(1.0 / RATE_HZ))
        assert crossings is not None
        odometry.step(crossings, 1.0 / RATE_HZ)
        out.append(crossings)
    return out


def judged(seen: Sequence[Crossings], wheels_stand: bool = False) -> list[str]:
    """What is said of every picture, "" for nothing."""
    odometry, check, out = VisualOdometry(Config().odometry), Pictures(), []
    for crossings in seen:
        said = check.judge(crossings, wheels_stand)
        assert said is None or said.severity is Severity.UNUSABLE
        check.add(crossings, odometry.step(None if said else crossings, 1.0 / RATE_HZ))
        out.append("" if said is None else said.kind.value)
    return out


def without_sample(seen: Sequence[Crossings]) -> list[Crossings]:
    return [replace(c, sample_gray=np.empty(0, np.uint8)) for c in seen]


@pytest.mark.parametrize("sampled", [True, False], ids=["sampled", "crossings only"])
@pytest.mark.parametrize("noise", [0.1, 1.0, 3.0])
def test_a_camera_that_drives_and_stands_is_live(noise: float, sampled: bool) -> None:
    seen = crossings_of([*drive(noise), *stand(noise)], noise)
    assert set(judged(seen if sampled else without_sample(seen))) == {""}


def test_a_camera_that_is_shaken_to_and_fro_is_live() -> None:
    """Every fourth picture is of the same place."""
    w = world(1.0)
    at = w.truth_at(0.0)
    places = [at + np.array([0.0005 * np.sin(0.5 * np.pi * k), 0.0, 0.0]) for k in range(20)]
    shaken = [w.renderer.render(pose, np.random.default_rng([8, k])) for k, pose in enumerate(places)]
    assert set(judged(crossings_of([*drive(1.0), *shaken], 1.0))) == {""}


@pytest.mark.parametrize("size", [2, 4, 8])
def test_a_ring_of_old_pictures_is_refused_from_its_first_on(size: int) -> None:
    """Found anew in every one of them, from another prediction."""
    said = judged(crossings_of([*drive(1.0), *(drive(1.0)[-size:] * 3)], 1.0))
    assert set(said[: len(drive(1.0))]) == {""}
    assert set(said[len(drive(1.0)) :]) == {Kind.REPEATS.value}


@pytest.mark.parametrize("size", [2, 4, 8])
def test_a_ring_of_old_crossings_is_refused_where_there_are_no_samples(size: int) -> None:
    live = without_sample(crossings_of(drive(1.0), 1.0))
    said = judged([*live, *(live[-size:] * 3)])
    assert set(said[: len(live)]) == {""}
    assert set(said[len(live) :]) == {Kind.REPEATS.value}


def test_a_frozen_picture_is_refused_from_its_first_on_unless_the_wheels_stand() -> None:
    seen = crossings_of([*drive(1.0), *([drive(1.0)[-1]] * 5)], 1.0)
    assert judged(seen)[-5:] == [Kind.FROZEN.value] * 5
    assert judged(seen, wheels_stand=True)[-5:] == [""] * 5


def last_bit(gray: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(gray ^ rng.integers(0, 2, gray.shape, dtype=np.uint8))


def one_up_or_down(gray: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.asarray(np.clip(gray.astype(int) + rng.integers(-1, 2, gray.shape), 0, 255), np.uint8)


def one_pixel(gray: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    out = gray.copy()
    out[rng.integers(gray.shape[0]), rng.integers(gray.shape[1])] ^= 1
    return out


@pytest.mark.parametrize("disguise", [last_bit, one_up_or_down, one_pixel])
@pytest.mark.parametrize("ring", [1, 4])
def test_noise_that_no_camera_has_does_not_disguise_an_old_picture(
    disguise: Callable[[np.ndarray, np.random.Generator], np.ndarray], ring: int
) -> None:
    """Once the camera's own noise has been seen, on a stand before the drive."""
    rng = np.random.default_rng(3)
    old = [disguise(gray, rng) for gray in drive(1.0)[-ring:] * (12 // ring)]
    said = judged(crossings_of([*drive(1.0), *old], 1.0))
    assert set(said[: len(drive(1.0))]) == {""}
    assert "" not in said[len(drive(1.0)) :]


def test_a_lamp_that_goes_out_while_the_robot_stands_is_no_frozen_camera() -> None:
    """Darker pictures have less noise."""
    dim = [np.asarray(0.3 * gray + 2.0, np.uint8) for gray in stand(1.0)]
    assert set(judged(crossings_of([*drive(1.0), *stand(1.0), *dim], 1.0))) == {""}
