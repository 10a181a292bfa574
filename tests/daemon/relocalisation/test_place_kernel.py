"""The loops over landmarks and places: the compiled kernel does what NumPy's does."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo.daemon.relocalisation import kernel
from ceilvo.daemon.relocalisation.kernel import reference
from ceilvo.daemon.relocalisation.kernel.arguments import Chains, Ground, Raster, Ratios
from ceilvo.daemon.relocalisation.place_index.blocks import BLOCK_SHIFT, LandmarkBlocks
from ceilvo.types import Landmarks

pytestmark = pytest.mark.skipif(not kernel.COMPILED, reason="ceilvo was installed without a compiler")
BOTH = pytest.mark.parametrize("k", [reference, kernel], ids=["numpy", "compiled"])
SEEDS = st.integers(0, 2**32 - 1)


def test_without_the_compiled_one_numpy_takes_over() -> None:
    code = (
        "import sys; sys.modules['ceilvo.daemon.relocalisation.kernel.evidence'] = None\n"
        "from ceilvo.daemon.relocalisation import kernel\n"
        "from ceilvo.daemon.relocalisation.kernel import reference\n"
        "assert not kernel.COMPILED and kernel.scored is reference.scored"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=dict(os.environ))
    assert done.returncode == 0, done.stderr


def chains_of(rng: np.random.Generator, landmarks: int) -> Chains:
    """Of a map with some landmarks removed again."""
    xy = rng.uniform(-4.0, 4.0, (landmarks, 2))
    kind, seen = rng.integers(0, 13, landmarks), np.full(landmarks, 9)
    blocks = LandmarkBlocks()
    slots = blocks.add(Landmarks(np.arange(landmarks), xy, np.tile(np.eye(2), (landmarks, 1, 1)), kind, seen), 100)
    blocks.remove(slots[:: int(rng.integers(2, 9))])
    d = blocks.directory
    return Chains(d.origin, d.number, blocks.head, blocks.chain, blocks.xy, blocks.crossing_type, BLOCK_SHIFT)


@given(SEEDS, st.integers(0, 200), st.integers(0, 9000))
@settings(max_examples=60, deadline=None)
def test_pairs_are_the_same(seed: int, landmarks: int, reach: int) -> None:
    rng = np.random.default_rng(seed)
    chains = chains_of(rng, landmarks)
    points = rng.integers(-20_000, 20_000, (int(rng.integers(0, 12)), 2)).astype(np.int32)
    found = [
        sorted(zip(*(v.tolist() for v in k.pairs(chains, points, reach)), strict=True)) for k in (reference, kernel)
    ]
    assert found[0] == found[1]
    off = np.abs(chains.xy[None] - points[:, None]).max(axis=2) <= reach  # and as all pairs, tried one by one, say
    live = chains.crossing_type >= 0
    assert found[1] == sorted(map(tuple, np.argwhere(off & live).tolist()))


@given(SEEDS, st.integers(0, 200))
@settings(max_examples=60, deadline=None)
def test_nearest_are_the_same(seed: int, landmarks: int) -> None:
    rng = np.random.default_rng(seed)
    chains = chains_of(rng, landmarks)
    points = rng.integers(-12_000, 12_000, (40, 2)).astype(np.int32)
    wanted = rng.integers(0, 1 << 13, 40).astype(np.uint16)
    (slot, apart), (slot_b, apart_b) = (k.nearest(chains, points, wanted, 600) for k in (reference, kernel))
    np.testing.assert_array_equal(slot_b, slot)
    np.testing.assert_array_equal(apart_b[slot >= 0], apart[slot >= 0])


def test_a_chain_that_leads_nowhere_is_an_error() -> None:
    chains = chains_of(np.random.default_rng(3), 60)
    at = chains.xy[chains.head[chains.head >= 0][:1]].astype(np.int32)
    for broken in (chains._replace(chain=np.full_like(chains.chain, 10**6)), chains._replace(chain=chains.chain * 0)):
        with pytest.raises(ValueError, match="leads nowhere"):
            kernel.pairs(broken, at, 9000)
        with pytest.raises(ValueError, match="leads nowhere"):
            kernel.nearest(broken, at, np.array([0xFFFF], np.uint16), 600)


@given(SEEDS, st.integers(0, 60))
@settings(max_examples=60, deadline=None)
def test_stamps_and_look_ups_are_the_same(seed: int, points: int) -> None:
    rng = np.random.default_rng(seed)
    disc = rng.integers(0, 2, (5, 5)).astype(np.uint8)
    place, bits = rng.integers(-3, 43, (points, 2)), rng.integers(0, 1 << 16, points).astype(np.uint16)
    cells = [np.zeros((30, 40), np.uint16) for _ in range(2)]
    for k, c in zip((reference, kernel), cells, strict=True):
        k.stamped(c, place, bits, disc)
    np.testing.assert_array_equal(cells[1], cells[0])
    raster = Raster(np.array([-5, 7]), cells[0], 0.025)
    at = np.concatenate([rng.uniform(-1.0, 2.0, (50, 2)), [[np.nan, 0.0], [1e30, -1e30]]])
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(kernel.looked_up(raster, at[:50]), reference.looked_up(raster, at[:50]))
    np.testing.assert_array_equal(kernel.looked_up(raster, at)[50:], 0)


@given(SEEDS, st.integers(0, 5))
@settings(max_examples=60, deadline=None)
def test_views_of_the_ground_are_the_same(seed: int, blocks: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = rng.integers(-2, 3, (2, blocks)) + (1 << 20)
    number = np.unique(x * (2 << 20) + y)
    ground = Ground(number, rng.integers(0, 256, (len(number), 32, 32)).astype(np.uint8), 0.25)
    at = rng.uniform(-20.0, 20.0, (80, 2))
    np.testing.assert_array_equal(kernel.views(ground, at), reference.views(ground, at))


@given(SEEDS, st.integers(0, 5), st.integers(0, 40), st.integers(0, 9))
@settings(max_examples=60, deadline=None)
def test_how_alike_the_map_is_shifted_is_the_same(seed: int, blocks: int, landmarks: int, shifts: int) -> None:
    rng = np.random.default_rng(seed)
    raster = Raster(np.array([-200, -200]), rng.integers(0, 1 << 15, (400, 400)).astype(np.uint16), 0.025)
    x, y = rng.integers(-1, 2, (2, blocks)) + (1 << 20)
    number = np.unique(x * (2 << 20) + y)
    ground = Ground(number, rng.integers(0, 12, (len(number), 32, 32)).astype(np.uint8), 0.25)
    xy, kind = rng.uniform(-6.0, 6.0, (landmarks, 2)), rng.integers(0, 13, landmarks)
    steps = rng.uniform(-3.0, 3.0, (shifts, 2))
    arguments = (raster, ground, 8, xy, kind, steps, 16, 1 << 14)
    found = kernel.alike(*arguments)
    np.testing.assert_array_equal(found, reference.alike(*arguments))
    true = np.zeros((3, shifts, 16))  # one by one
    for j, step in enumerate(steps):
        for at, own in zip(xy + step, kind.tolist(), strict=True):
            if reference.views(ground, at[None])[0] >= 8:
                bits = int(reference.looked_up(raster, at[None])[0])
                true[:, j, own] += (1, bits >> own & 1, bool(bits & (1 << own | 1 << 14)))
    np.testing.assert_array_equal(found, true)


def test_a_type_that_there_is_not_is_refused() -> None:
    raster = Raster(np.zeros(2, np.int64), np.zeros((1, 1), np.uint16), 0.025)
    ground = Ground(np.empty(0, np.int64), np.empty((0, 32, 32), np.uint8), 0.25)
    with pytest.raises(ValueError, match="landmark 1: type 16, expected 0 to 15"):
        kernel.alike(raster, ground, 8, np.zeros((2, 2)), np.array([0, 16]), np.zeros((1, 2)), 16, 1 << 14)


def scene(seed: int, places: int, features: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    tables = [rng.normal(0.0, 2.0, (32, 13, 8)) for _ in range(3)]
    return {
        "ratios": Ratios(*tables, 8, 8),
        "views": rng.integers(0, 30, (places, features)),
        "types": rng.integers(0, 13, (places, features)),
        "matched": rng.random((places, features)) < 0.5,
        "other": rng.random((places, features)) < 0.3,
        "worth": rng.uniform(0.0, 1.0, (8, features)),
        "lines": rng.integers(0, 5, (features, 2)),
    }


@given(SEEDS, st.integers(0, 6), st.integers(0, 50))
@settings(max_examples=60, deadline=None)
def test_scores_are_the_same(seed: int, places: int, features: int) -> None:
    given_ = scene(seed, places, features)
    np.testing.assert_allclose(kernel.scored(**given_), reference.scored(**given_), rtol=1e-12, atol=1e-11)


def test_a_line_is_worth_two_features() -> None:
    """Five features of one line on known ground, without a landmark: two of them count."""
    one = scene(1, 1, 5) | {
        "views": np.full((1, 5), 20),
        "types": np.zeros((1, 5), np.int64),
        "matched": np.zeros((1, 5), bool),
        "other": np.zeros((1, 5), bool),
        "worth": np.ones((8, 5)),
        "lines": np.column_stack([np.zeros(5, np.int64), np.arange(5)]),
    }
    np.testing.assert_allclose(kernel.scored(**one)[0], 2.0 * one["ratios"].loss[2, 0], rtol=1e-12)


@given(SEEDS, st.integers(0, 6), st.integers(0, 50))
@settings(max_examples=60, deadline=None)
def test_what_is_missed_is_the_same(seed: int, places: int, landmarks: int) -> None:
    rng = np.random.default_rng(seed)
    raster = Raster(np.array([-40, -40]), rng.integers(0, 1 << 16, (80, 80)).astype(np.uint16), 0.025)
    arguments = (
        raster,
        rng.uniform(-1.0, 1.0, (places, 3)),
        rng.uniform(-2.0, 2.0, (landmarks, 2)),
        np.left_shift(1, rng.integers(0, 13, (4, landmarks))).astype(np.uint16),
        rng.integers(0, 4, places),
        1 << 15,
        1 << 14,
        rng.normal(-1.0, 1.0, (landmarks, 8)),
        rng.integers(0, 7, (landmarks, 2)),
    )
    np.testing.assert_allclose(kernel.missed(*arguments), reference.missed(*arguments), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        {"views": np.full((2, 4), 999)},
        {"types": np.full((2, 4), 13)},
        {"lines": np.full((4, 2), -1)},
        {"lines": np.zeros((3, 2), np.int64)},
        {"worth": np.ones((8, 5))},
        {"matched": np.zeros((1, 4), bool)},
    ],
)
def test_arguments_that_do_not_fit_together_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"features?|crossing|lines|worth|matched"):
        kernel.scored(**(scene(2, 2, 4) | wrong))
