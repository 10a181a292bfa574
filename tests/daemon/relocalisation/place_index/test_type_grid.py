"""Cells against the nearest landmark by brute force; what was added, moved and removed against what is left."""

from __future__ import annotations

import copy
from dataclasses import fields

import numpy as np
import place_maps
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.crossing_types import CROSSING_TYPES, LINE_CROSSINGS
from ceilvo.daemon.relocalisation.place_index.blocks import BLOCK_M, FINE_M, LandmarkBlocks, fine
from ceilvo.daemon.relocalisation.place_index.id_table import IdTable
from ceilvo.daemon.relocalisation.place_index.type_grid import GROUND, GROUND_M, HALF_DIAGONAL_M, TypeGrid
from ceilvo.types import Landmarks

TYPES = [t for t in range(CROSSING_TYPES) if t != LINE_CROSSINGS]  # between crossings and points is no type
AT = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.sampled_from(TYPES))
MAPS = st.lists(AT, min_size=1, max_size=20).map(np.array)
ROUND_M = 2 * FINE_M
"""Positions are rounded to FINE_M."""


def of_rows(rows, first_id=0):
    return place_maps.map_of(rows[:, :2], rows[:, 2].astype(np.int64), first_id)


@settings(max_examples=80, deadline=None)
@given(MAPS, st.lists(AT, min_size=1, max_size=30).map(np.array), st.sampled_from([0.1, 0.15, 0.3]))
def test_a_cell_knows_what_is_within_reach_and_nothing_beyond(rows, points, reach_m):
    known, (x, y) = of_rows(rows), fine(points[:, :2]).T
    kind = points[:, 2].astype(np.int64)
    bits = TypeGrid.of(known, reach_m).bits(x, y)
    for has, apart, within in (
        ((bits >> kind.astype(np.uint16)) & 1, place_maps.nearest(known, points[:, :2], kind), reach_m),
        (bits & GROUND, place_maps.nearest(known, points[:, :2], None), GROUND_M),
    ):
        assert np.all(has[apart < within - HALF_DIAGONAL_M - ROUND_M] > 0)
        assert not np.any(has[apart > within + HALF_DIAGONAL_M + ROUND_M])


@pytest.mark.parametrize("turns", range(4))
def test_poses_are_asked_with_the_types_of_their_own_quarter(turns):
    rng = np.random.default_rng(turns)
    known = place_maps.random_map(rng, 60, 6.0)
    grid, pose = TypeGrid.of(known), np.array([0.4, -0.3, 0.7])
    view = place_maps.view_of(known, pose, rng, turns)
    poses = np.concatenate([pose[None], pose + rng.uniform(-2, 2, (40, 3))])
    there, ground = grid.hits(poses, view)
    assert there.shape == ground.shape == (41, len(view))
    assert np.all(there[0])
    least = place_maps.explained(known, poses, view, grid.reach_m - HALF_DIAGONAL_M - ROUND_M)
    most = place_maps.explained(known, poses, view, grid.reach_m + HALF_DIAGONAL_M + ROUND_M)
    count = np.count_nonzero(there, axis=1)
    assert np.all((count >= least) & (count <= most))
    assert np.all(ground[there])


CHANGES = st.lists(st.tuples(st.sampled_from(["add", "remove"]), MAPS), min_size=1, max_size=6)


@settings(max_examples=40, deadline=None)
@given(CHANGES, st.integers(0, 2**16))
def test_a_grid_that_changed_is_the_grid_of_what_is_left(changes, seed):
    rng = np.random.default_rng(seed)
    grid, left, given_out = TypeGrid(), {}, 0
    for what, rows in changes:
        if what == "add":
            grid.add(of_rows(rows, given_out))
            left |= {given_out + i: row for i, row in enumerate(rows)}
            given_out += len(rows)
        else:
            gone = rng.permutation(list(left))[: len(rows)].astype(np.int64)
            slots = grid.blocks.find(gone)
            assert np.array_equal(grid.blocks.ids[slots], gone)
            grid.remove(slots)
            left = {i: row for i, row in left.items() if i not in gone}
    assert len(grid) == len(left)
    fresh = TypeGrid.of(of_rows(np.array(list(left.values())).reshape(-1, 3)))
    g = np.arange(-4.0, 4.0, 0.05)
    x, y = fine(np.stack(np.meshgrid(g, g))).reshape(2, -1)
    np.testing.assert_array_equal(grid.bits(x, y), fresh.bits(x, y))


def test_another_map_replaces_all():
    rng = np.random.default_rng(1)
    grid, other = TypeGrid.of(place_maps.random_map(rng, 50, 8.0)), place_maps.random_map(rng, 20, 8.0)
    grid.replace(other)
    x, y = fine(rng.uniform(-5, 5, (2, 2000)))
    np.testing.assert_array_equal(grid.bits(x, y), TypeGrid.of(other).bits(x, y))


def test_a_reach_that_the_ground_does_not_cover_is_refused():
    with pytest.raises(ValueError, match=r"reach_m is 0\.5"):
        TypeGrid(0.5)


def test_memory_is_the_landmarks_area():
    rng = np.random.default_rng(2)
    small, large = (TypeGrid.of(place_maps.random_map(rng, n, np.sqrt(n / 2))) for n in (3000, 12_000))
    assert large.nbytes < 4.2 * small.nbytes
    far_apart = place_maps.map_of(np.array([[0.0, 0.0], [1000.0, 800.0]]), np.array([4, 4]))
    assert TypeGrid.of(far_apart).cells.nbytes <= 9 * 512


def test_a_landmark_beyond_all_buildings_is_left_out_and_said():
    xy = np.array([[0.0, 0.0], [1e7, 0.0], [90_000.0, 90_000.0], [1.0, 1.0]])
    grid = TypeGrid.of(place_maps.map_of(xy, np.array([4, 4, 4, 4])))
    assert len(grid) == 2
    assert grid.blocks.left_out == 2
    assert grid.bits(*fine(xy).T).astype(bool).tolist() == [True, False, False, True]


@settings(max_examples=60, deadline=None)
@given(MAPS, MAPS, st.floats(0.01, 0.5 * BLOCK_M))
def test_near_and_nearest_are_what_brute_force_finds(rows, points, reach_m):
    known, reach = of_rows(rows), int(fine(np.array(reach_m)))
    blocks = LandmarkBlocks()
    slots = blocks.add(known, reach)
    at, kind = points[:, :2], points[:, 2].astype(np.int64)
    apart = np.abs(fine(at)[:, None] - fine(known.xy_map_m)).astype(np.int64)
    near = np.flatnonzero(np.any(np.max(apart, axis=2) <= reach, axis=0))
    assert set(blocks.near(fine(at), reach).tolist()) == set(slots[near].tolist())
    pairs = {(int(i), int(s)) for i, s in zip(*blocks.pairs(fine(at), reach), strict=True)}
    assert pairs == {(int(i), int(slots[k])) for i, k in zip(*np.nonzero(np.max(apart, axis=2) <= reach), strict=True)}
    label, distance = blocks.nearest(fine(at), np.left_shift(1, kind).astype(np.uint16), reach)
    true = np.hypot(*np.moveaxis(apart, 2, 0).astype(float))
    true[kind[:, None] != known.crossing_type] = np.inf
    best = np.min(true, axis=1)
    np.testing.assert_array_equal(label >= 0, best <= reach)
    np.testing.assert_allclose(distance[label >= 0], best[label >= 0])


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.sets(st.integers(-(2**62), 2**62), min_size=1, max_size=40)), max_size=12))
def test_the_table_of_ids_is_a_dictionary(steps):
    table, stored, true = IdTable(), np.zeros(0, np.int64), {}
    for insert, ids in steps:
        if insert:
            fresh = np.array([i for i in ids if i not in true], np.int64)
            slots = (len(stored) + np.arange(len(fresh))).astype(np.int32)
            stored = np.append(stored, fresh)
            table.insert(fresh, slots, stored)
            true |= dict(zip(fresh.tolist(), slots.tolist(), strict=True))
        else:
            gone = np.array(sorted(set(list(true)[::2]) | (ids & set(true))), np.int64)
            table.remove(gone, stored)
            true = {i: s for i, s in true.items() if i not in gone}
        asked = np.array([*true, *ids], np.int64)
        assert table.find(asked, stored).tolist() == [true.get(int(i), -1) for i in asked]


@pytest.mark.parametrize("entries", [[], [0, 1, 2], list(range(64))])
def test_a_table_from_which_no_search_comes_back_is_refused(entries: list[int]) -> None:
    with pytest.raises(ValueError, match="power of two"):
        IdTable(np.array(entries, np.int32))


def test_chains_that_lead_round_and_round_are_refused() -> None:
    """As they may be in a damaged recording, field by field."""
    blocks = LandmarkBlocks()
    xy = np.random.default_rng(5).uniform(0.0, 3.0, (40, 2))
    m = Landmarks(np.arange(40), xy, np.tile(np.eye(2), (40, 1, 1)), np.full(40, 4), np.full(40, 9))
    slots = blocks.add(m, 0)
    blocks.remove(slots[::3])
    names = [f.name for f in fields(LandmarkBlocks)]

    def again(**changed: object) -> LandmarkBlocks:
        return LandmarkBlocks(**{n: copy.deepcopy(getattr(blocks, n)) for n in names} | changed)  # type: ignore[arg-type]

    assert len(again()) == len(blocks)
    live = blocks.live
    loop, elsewhere = blocks.chain.copy(), blocks.xy.copy()
    loop[live[0]] = live[0]
    elsewhere[live[0]] += 1 << 20
    for changed in (
        {"chain": loop},
        {"chain": blocks.chain[:-1]},
        {"xy": elsewhere},
        {"head": blocks.head[:1]},
        {"freed": len(blocks.free) + 1},
        {"length": 0},
    ):
        with pytest.raises(ValueError, match=r"chain|columns"):
            again(**changed)
