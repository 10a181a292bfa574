"""Ranges against a simulated radio whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from ceilvo import se2
from ceilvo.daemon.relocalisation.beacons.anchors import AnchorTable
from ceilvo.daemon.relocalisation.beacons.range_errors import (
    NONSENSE,
    NONSENSE_M,
    OBSTRUCTED,
    OBSTRUCTED_M,
    direct_share,
    log_density,
)
from ceilvo.daemon.relocalisation.beacons.range_window import RangeWindow, find, lever
from ceilvo.senses.beacons import Anchor
from ceilvo.sim.radio import Radio, RadioSpec, in_corners, surveyed
from ceilvo.types import Array

TAG_M = np.array([0.2, 0.1, 0.5])
LOW, HIGH = np.zeros(2), np.array([20.0, 15.0])


@pytest.mark.parametrize("sigma_m", [0.05, 0.1, 0.3])
def test_the_density_is_the_mixture_that_it_says(sigma_m: float) -> None:
    e = np.linspace(-1.0, 6.0, 141)
    tail = stats.exponnorm(OBSTRUCTED_M / sigma_m, scale=sigma_m).pdf(e)
    direct = (1.0 - OBSTRUCTED - NONSENSE) * stats.norm(scale=sigma_m).pdf(e)
    wanted = direct + OBSTRUCTED * tail + NONSENSE / NONSENSE_M
    np.testing.assert_allclose(np.exp(log_density(e, sigma_m)), wanted, rtol=2e-4, atol=1e-6)
    np.testing.assert_allclose(direct_share(e, sigma_m), direct / wanted, atol=1e-3)


def drive(
    window: RangeWindow, radio: Radio, table: AnchorTable, map_from_odom: Array, steps: int
) -> tuple[Array, Array]:
    """(3,) poses in odom and map at the end of an arc of 2 cm steps, one round of ranges each."""
    odom = np.zeros(3)
    for k in range(steps):
        odom = np.asarray(se2.compose(odom, np.array([0.02, 0.0, 0.004])))
        pose = np.asarray(se2.compose(map_from_odom, odom))
        heard = radio.ranges(k, np.array([*lever(pose, TAG_M[:2]), TAG_M[2]]))
        which = np.array([table.names.index(r.anchor) for r in heard], np.int64)
        at = np.repeat(lever(odom, TAG_M[:2])[None], len(heard), axis=0)
        window.add(at, which, np.array([r.range_m for r in heard]))
    return odom, np.asarray(se2.compose(map_from_odom, odom))


def radio_of(seed: int, anchors: int, spec: RadioSpec) -> tuple[Radio, AnchorTable, np.random.Generator]:
    rng = np.random.default_rng(seed)
    true = in_corners(LOW, HIGH, anchors, rng)
    return Radio(true, spec, rng), AnchorTable.of(surveyed(true, 0.05, rng), spec.noise_m), rng


def test_a_fix_is_where_the_robot_is_and_its_covariance_holds() -> None:
    errors = []
    for seed in range(12):
        radio, table, rng = radio_of(seed, 4, RadioSpec(noise_m=0.2, obstructed=0.0))
        map_from_odom = np.array([*rng.uniform(LOW + 2.0, HIGH - 2.0), rng.uniform(-np.pi, np.pi)])
        window = RangeWindow()
        odom, pose = drive(window, radio, table, map_from_odom, 40)
        headings = pose[2] + 0.5 * np.pi * np.arange(4)
        fix = find(window, table, float(TAG_M[2]), odom, headings)
        assert fix is not None, seed
        off = fix.pose[:2] - pose[:2]
        errors.append(float(off @ np.linalg.solve(fix.cov, off)))
        assert np.hypot(*off) < 0.6, (seed, off)
    print("squared distances over their covariance", np.round(errors, 2))
    assert np.mean(errors) < stats.chi2(2 * len(errors)).ppf(0.999) / len(errors)


def test_places_a_lamp_raster_apart_are_told_apart_and_turned_ones_by_driving() -> None:
    won = 0
    for seed in range(20):
        radio, table, rng = radio_of(100 + seed, 3, RadioSpec(noise_m=0.3, obstructed=0.0))
        map_from_odom = np.array([*rng.uniform(LOW + 4.0, HIGH - 4.0), rng.uniform(-np.pi, np.pi)])
        window = RangeWindow()
        odom, pose = drive(window, radio, table, map_from_odom, 75)
        shifts = [[dx, dy, 0.0] for dx in (-2.4, 0.0, 2.4) for dy in (-1.8, 0.0, 1.8)]
        around = np.array([*shifts, [0.0, 0.0, np.pi], [0.0, 0.0, 0.5 * np.pi], [0.0, 0.0, -0.5 * np.pi]])
        value = window.log_likelihood(table, float(TAG_M[2]), odom, pose + around)
        won += int(np.argmax(value)) == 4
    assert won == 20


def test_an_obstructed_path_is_one_thing_however_often_it_is_measured() -> None:
    """Else a wrong place at which all paths seem straight would win by hundreds."""
    radio, table, _ = radio_of(7, 3, RadioSpec(noise_m=0.1, obstructed=0.0, lost=0.0, offset_m=0.0, curve=0.0))
    window = RangeWindow()
    odom, pose = drive(window, radio, table, np.array([9.0, 7.0, 0.3]), 50)
    window.range_m[window.anchor == 1] += 1.5
    places = pose + np.array([[0.0, 0.0, 0.0], [-1.0, 0.2, 0.0], [-1.8, 0.0, 0.0], [0.0, 1.8, 0.0]])
    value = window.log_likelihood(table, float(TAG_M[2]), odom, places)
    print("log-likelihoods of the truth and of places beside it", np.round(value, 1))
    assert value[0] > np.max(value) - 12.0


def test_offset_and_scale_of_an_anchor_are_learnt_with_honest_sigmas() -> None:
    rng = np.random.default_rng(3)
    anchors = (Anchor("A", 0.0, 0.0, 2.0, sigma_m=0.0), Anchor("B", 20.0, 0.0, 2.0, sigma_m=0.0))
    table = AnchorTable.of(anchors, 0.1)
    true = np.array([[0.25, 0.004], [-0.2, -0.003]])
    for _ in range(1500):
        at = rng.uniform(LOW, HIGH)[None]
        which = np.array([int(rng.integers(2))])
        distance, _ = table.distances(which, at, 0.5)
        error = 0.1 * rng.standard_normal() + (rng.uniform(0.2, 2.0) if rng.random() < 0.2 else 0.0)
        said = true[which[0], 0] + (1.0 + true[which[0], 1]) * distance + error
        table.learn(which, at, 0.5, said)
    off = table.fit - true
    nees = [float(o @ np.linalg.solve(c, o)) for o, c in zip(off, table.cov, strict=True)]
    print("offsets", table.fit[:, 0], "scales", table.fit[:, 1], "noise", table.noise_m, "NEES", np.round(nees, 1))
    assert np.all(np.abs(off[:, 0] + off[:, 1] * 10.0) < 0.05)
    assert 0.06 < table.noise_m < 0.2
    before = AnchorTable.of(anchors, 0.1)
    assert np.all(np.diagonal(table.cov, axis1=1, axis2=2) < 0.3 * np.diagonal(before.cov, axis1=1, axis2=2))


def test_what_is_learnt_stays_within_bounds() -> None:
    table = AnchorTable.of((Anchor("A", 0.0, 0.0, 0.5, 0.0, offset_sigma_m=2.0),), 0.1)
    for k in range(200):
        at = np.array([[1.0 + 0.3 * k, 0.0]])
        table.learn(np.array([0]), at, 0.5, np.array([1.0 + 0.3 * k + 1.8]))
    assert abs(float(table.fit[0, 0])) <= 1.0 and abs(float(table.fit[0, 1])) <= 0.02
