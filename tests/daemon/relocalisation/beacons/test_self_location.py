"""Anchors found from a drive among them, against where they are."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from ceilvo.daemon.relocalisation.beacons.self_location import locate, locate_all
from ceilvo.senses.beacons import Anchor
from ceilvo.sim.radio import Radio, RadioSpec
from ceilvo.types import Array

TRUE = (Anchor("A000", 0.5, -1.0, 2.2), Anchor("B000", 14.0, 3.0, 1.9), Anchor("C000", 6.0, 12.0, 2.4))


def lap() -> Array:
    """(N, 2) places of the tag on a lap of 12 m by 8 m, every 5 cm."""
    corners = np.array([[1.0, 1.0], [13.0, 1.0], [13.0, 9.0], [1.0, 9.0], [1.0, 1.0]])
    sides = [a + np.outer(np.arange(0.0, 1.0, 0.05 / np.hypot(*(b - a))), b - a) for a, b in pairwise(corners)]
    return np.concatenate(sides)


def test_anchors_are_found_within_their_sigmas_in_spite_of_obstructed_paths() -> None:
    off, squared = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        radio = Radio(TRUE, RadioSpec(noise_m=0.1, obstructed=0.2), rng)
        heard = [(r.anchor, at, r.range_m) for k, at in enumerate(lap()) for r in radio.ranges(k, np.array([*at, 0.5]))]
        for found, true in zip(locate_all(heard, 0.5, 2.0, 0.1), TRUE, strict=True):
            assert found.anchor is not None, (seed, found)
            error = np.array([found.anchor.x_m - true.x_m, found.anchor.y_m - true.y_m])
            off.append(float(np.hypot(*error)))
            squared.append(float(np.sum(error**2)) / found.anchor.sigma_m**2)
    print("errors m", np.round(off, 3), "over sigma, squared", np.round(squared, 1))
    assert max(off) < 0.35 and np.median(off) < 0.15


def test_without_noise_they_are_where_they_are() -> None:
    at = lap()
    for a in TRUE:
        ranges = np.sqrt((at[:, 0] - a.x_m) ** 2 + (at[:, 1] - a.y_m) ** 2 + (a.z_m - 0.5) ** 2)
        found = locate(a.name, at, ranges, 0.5, a.z_m, 0.05)
        assert found.anchor is not None
        assert np.hypot(found.anchor.x_m - a.x_m, found.anchor.y_m - a.y_m) < 0.002


@pytest.mark.parametrize(("tags", "says"), [(lap()[:20], "spots"), (lap()[:120] * [1.0, 0.0], "more than one line")])
def test_a_drive_that_cannot_tell_is_told(tags: Array, says: str) -> None:
    rng = np.random.default_rng(1)
    radio = Radio(TRUE[:1], RadioSpec(obstructed=0.0, lost=0.0), rng)
    ranges = np.array([radio.ranges(k, np.array([*t, 0.5]))[0].range_m for k, t in enumerate(tags)])
    found = locate("A000", tags, ranges, 0.5, 2.0, 0.1)
    print(found.problem)
    assert found.anchor is None and says in found.problem
