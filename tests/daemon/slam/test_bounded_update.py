"""However much a view shows, an update is made with a bounded part of it, and what is left out is not forgotten."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.config import Filter
from ceilvo.daemon.relocalisation.filters import make_filter
from ceilvo.daemon.slam.association import MOST_FEATURES, spread_out
from ceilvo.daemon.slam.conditional import Conditional
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.se2 import compose, inverse, transform, wrap
from ceilvo.types import NO_LANDMARK, Array, Displacement, Landmarks, Motion, Observations

SEED = 29
HALF = np.array([1.3, 1.0])
VISIBLE = HALF * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
SIGMA_M = 0.01


def world(features: int, seed: int = SEED) -> tuple[Array, Array]:
    """Points and types of a ceiling of which a view shows so many."""
    rng = np.random.default_rng(seed)
    n = round(features * 64.0 / (4.0 * HALF[0] * HALF[1]))
    return rng.uniform(-4, 4, (n, 2)), rng.integers(0, 500, n)


def robot(known: Landmarks | None, pose: Array, method: str = "joint") -> PoseFilter:
    settings = replace(Filter(), method=method, feature_independence=1.0, association_gate_m=0.3, slip_per_m=0.0)
    f = make_filter(settings, np.random.default_rng(SEED))
    f.reset(pose, 1e-8 * np.eye(3), known)
    return f


def look(f: PoseFilter, pose: Array, xy: Array, kind: Array, rng: np.random.Generator) -> int:
    """One update with all that is in view; how much that was."""
    at = transform(inverse(pose), xy)
    seen = np.flatnonzero(np.all(np.abs(at) < HALF, axis=1))
    z = at[seen] + SIGMA_M * rng.standard_normal((len(seen), 2))
    label = np.full(len(z), NO_LANDMARK)
    labels, near = f.landmarks_near(transform(f.estimate()[0], z), 0.3)
    for i, p in enumerate(transform(f.estimate()[0], z)):
        off = np.hypot(*(near.xy_map_m - p).T) + np.where(near.crossing_type == kind[seen[i]], 0.0, np.inf)
        label[i] = labels[np.argmin(off)] if np.min(off, initial=np.inf) < 0.3 else NO_LANDMARK
    heading = float(pose[2] + 2e-3 * rng.standard_normal())
    variance = np.full((len(z), 2), SIGMA_M**2)
    f.update(Observations(z, variance, kind[seen], label, heading, 4e-6, visible_m=VISIBLE))
    return len(z)


@given(st.integers(0, 2**31), st.integers(0, 300), st.integers(0, 80), st.integers(0, 1000))
def test_so_many_at_most_each_once_and_in_order(seed: int, n: int, most: int, turn: int) -> None:
    xy = np.random.default_rng(seed).uniform(-1, 1, (n, 2)) * [3.0, 0.5]
    chosen = spread_out(xy, most, turn)
    assert len(chosen) == min(n, most)
    assert np.all(np.diff(chosen) > 0)
    assert np.array_equal(chosen, spread_out(xy, most, turn))


def test_every_feature_has_its_turn() -> None:
    xy = np.random.default_rng(SEED).uniform(-1, 1, (1000, 2))
    taken = np.zeros(1000, int)
    for turn in range(160):
        taken[spread_out(xy, 64, turn)] += 1
    print(f"1000 features, 64 a turn, 160 turns: each {taken.min()} to {taken.max()} times, 10.2 expected")
    assert taken.min() >= 8 and taken.max() <= 13


@pytest.mark.parametrize("turn", [0, 1, 7])
def test_what_is_chosen_is_all_over_the_view(turn: int) -> None:
    """Every disc of a tenth of the view holds some; of as many at random it does not."""
    xy = np.random.default_rng(SEED).uniform(-HALF, HALF, (1000, 2))
    chosen = xy[spread_out(xy, 64, turn)]
    centres = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 9), np.linspace(-0.7, 0.7, 7)), -1).reshape(-1, 2)
    radius = np.sqrt(0.1 * 4.0 * HALF[0] * HALF[1] / np.pi)
    held = [np.count_nonzero(np.hypot(*(chosen - c).T) < radius) for c in centres]
    print(f"turn {turn}: {min(held)} to {max(held)} of 64 in a tenth of the view")
    assert min(held) >= 3 and max(held) <= 12


@pytest.mark.parametrize("method", ["joint", "ukf", "pf"])
@pytest.mark.parametrize("mapped", [True, False])
def test_a_view_of_a_thousand_is_worked_on_in_part_only(
    method: str, mapped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    xy, kind = world(1000)
    n = len(xy)
    known = Landmarks(np.arange(n), xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), kind, np.full(n, 9)) if mapped else None
    f, rng = robot(known, np.zeros(3), method), np.random.default_rng(SEED)
    sizes: list[int] = []
    made = Conditional.__init__

    def spy(self: Conditional, view: object, *more: object) -> None:
        sizes.append(len(view))  # type: ignore[arg-type]
        made(self, view, *more)  # type: ignore[arg-type]

    monkeypatch.setattr(Conditional, "__init__", spy)
    for _ in range(3):
        assert look(f, np.zeros(3), xy, kind, rng) > 900
    assert f.estimate()[2].nis_dof <= 2 * MOST_FEATURES
    assert f.counters()["births"] <= 3 * MOST_FEATURES
    assert max(sizes, default=0) <= MOST_FEATURES


def most_memory(landmarks: int, known: bool) -> int:
    """Bytes that steps of a robot take for a while, in the middle of a grid of so many landmarks."""
    side = 2 * round(0.5 * np.sqrt(landmarks))
    g = 0.3 * (np.arange(side) - 0.5 * (side - 1))
    xy = np.stack(np.meshgrid(g, g), -1).reshape(-1, 2)
    n, kind = len(xy), np.floor(xy.sum(axis=1) / 0.3 + 0.5).astype(np.int64) % 9
    m = Landmarks(np.arange(n), xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), kind, np.full(n, 9))
    here = m.of(np.all(np.abs(xy) < 2.0, axis=1))
    kinds = np.append(here.crossing_type, [1, 2])
    f, rng = make_filter(Filter(), np.random.default_rng(SEED)), np.random.default_rng(SEED)
    f.reset(np.zeros(3), 1e-8 * np.eye(3), m, known)

    def step(there_m: float) -> None:
        for pose, moved in ((np.zeros(3), there_m), (np.array([there_m, 0.0, 0.0]), -there_m)):
            look(f, pose, np.concatenate([here.xy_map_m, rng.uniform(-1, 1, (2, 2))]), kinds, rng)
            f.predict(Motion(Displacement(np.array([moved, 0.0, 0.0])), 1e-8 * np.eye(3), 20, 0.0))

    for _ in range(3):
        step(0.06)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(3):
        step(0.06)
    peak = tracemalloc.get_traced_memory()[1] - before
    tracemalloc.stop()
    return peak


@pytest.mark.parametrize("known", [False, True], ids=["mapping", "known"])
def test_a_step_makes_nothing_that_is_as_large_as_the_map(known: bool) -> None:
    """A mask of the large map alone has 160,000 bytes."""
    small, large = most_memory(400, known), most_memory(160_000, known)
    print(f"{small} bytes on 400 landmarks, {large} on 160,000")
    assert abs(large - small) < 80_000


def test_all_of_a_dense_ceiling_is_mapped_and_counted() -> None:
    """Update by update, and nothing that the update was not made with is taken for missing."""
    xy, kind = world(400)
    f, rng, seen = robot(None, np.zeros(3)), np.random.default_rng(SEED), 0
    for i in range(24):
        step = np.array([0.05 if i % 4 < 2 else -0.05, 0.0, 0.0])
        f.predict(Motion(Displacement(step), 1e-8 * np.eye(3), 20, 0.0))
        seen = look(f, np.array([0.05 * (1, 2, 1, 0)[i % 4], 0.0, 0.0]), xy, kind, rng)
    m = f.landmarks()
    middle = m.of(np.all(np.abs(m.xy_map_m) < HALF - 0.15, axis=1))
    there = np.count_nonzero(np.all(np.abs(xy) < HALF - 0.15, axis=1))
    print(f"{seen} in view: {len(middle)} of {there} mapped, visibility {middle.visibility.min():.2f} at least")
    assert len(middle) > 0.97 * there
    assert f.counters()["faded"] == 0
    assert np.mean(middle.visibility > 0.8) > 0.98
    nearest = np.min(np.hypot(*(m.xy_map_m[:, None] - xy[None]).transpose(2, 0, 1)), axis=1)
    assert np.quantile(nearest, 0.95) < 3 * SIGMA_M


@pytest.mark.parametrize("features", [40, 150])
def test_it_is_honest_about_its_errors_whatever_it_leaves_out(features: int) -> None:
    """The pose's NEES on a circle; the landmarks that take part must stay those whose errors the filter knows."""
    nees = []
    for seed in range(3):
        rng, (xy, kind) = np.random.default_rng(seed), world(features, seed)
        pose = np.array([1.5, 0.0, np.pi / 2])
        f = robot(None, pose)
        for i in range(80):
            step, sigma = np.array([0.07, 0.0, 0.07 / 1.5]), np.array([4e-3, 3e-3, 3e-3])
            pose = compose(pose, step)
            told = Displacement(step + sigma * rng.standard_normal(3))
            f.predict(Motion(told, np.diag(sigma**2), 20, 0.0))
            look(f, pose, xy, kind, rng)
            if i % 5 == 4:
                at, cov, _ = f.estimate()
                off = at - pose
                off[2] = wrap(float(off[2]))
                nees.append(off @ np.linalg.solve(cov, off))
    print(f"{features} in view, seeds 0-2: NEES median {np.median(nees):.2f}, 2.37 expected of 3 dof")
    assert 0.8 < np.median(nees) < 4.5
