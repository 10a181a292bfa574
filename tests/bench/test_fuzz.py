"""Mutated and arbitrary bytes into every reader: our own errors, one clear line, or nothing."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.bench.fuzz.command import mutated
from ceilvo.bench.fuzz.targets import TARGETS, run, seeds


@pytest.mark.parametrize("name", TARGETS)
def test_the_seeds_are_read_without_an_error(name: str) -> None:
    if name == "pose_message":
        pytest.skip("its seed is a part of a message")
    for seed in seeds(name):
        TARGETS[name](seed)


@pytest.mark.parametrize("name", TARGETS)
@given(data=st.binary(max_size=300))
def test_any_bytes(name: str, data: bytes) -> None:
    run(TARGETS[name], data)


@pytest.mark.parametrize("name", TARGETS)
@given(number=st.integers(0, 2**32))
def test_mutated_valid_input(name: str, number: int) -> None:
    rng = random.Random(number)
    run(TARGETS[name], mutated(rng.choice(seeds(name)), rng))
