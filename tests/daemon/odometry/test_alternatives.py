"""Displacements between two views under simulated ceilings: which fit, which is right, and when that cannot be told."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from crossing_camera import CrossingCamera, Flaws
from hypothesis import given, settings
from hypothesis import strategies as st

from ceilvo import se2
from ceilvo.daemon.odometry.alternatives import Candidates, Prior, by_two_views, find_candidates
from ceilvo.daemon.odometry.lines.direction import direction_change
from ceilvo.daemon.odometry.odometry_state import APART, EarlierView
from ceilvo.daemon.relocalisation.doubts import UNLIKELY
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.types import Crossings

SIDE_M = 40.0
RATE = 1e-4
TILE_M = 0.6
LAMPS = CeilingSpec(room_m=SIDE_M, tile_m=TILE_M)
BARE_GRID = CeilingSpec(room_m=SIDE_M, tile_m=TILE_M, lamp_every=(0, 0), vents=0)
FLICKERS = Flaws(lines=0.04, crossings=0.08, kinds=0.06)
"""Views that err several times as often as usual."""
SPECS = {"lamps": LAMPS, "grid": BARE_GRID, "small tiles": CeilingSpec(room_m=SIDE_M, tile_m=0.3)}


@cache
def camera(name: str, seed: int = 1, flawless: bool = False) -> CrossingCamera:
    return CrossingCamera.under(SPECS[name], seed, Flaws(0.0, 0.0, 0.0, 0.0, 0.0) if flawless else None)


@cache
def flickering(seed: int) -> CrossingCamera:
    """What hangs there comes and goes, and so do joints."""
    return CrossingCamera.under(SPECS["small tiles"], seed, FLICKERS)


def somewhere(rng: np.random.Generator) -> np.ndarray:
    return np.array([*rng.uniform(0.2 * SIDE_M, 0.8 * SIDE_M, 2), rng.uniform(-np.pi, np.pi)])


def compared(ref: Crossings, curr: Crossings, mean: np.ndarray, sigma: np.ndarray, carried: float = 1e-4) -> Candidates:
    turn = direction_change(ref.psi_rad, curr.psi_rad, float(mean[2]))
    return find_candidates(ref, curr, turn, Prior(mean, np.diag(sigma**2), carried))


def is_at(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(K,) which displacements are the true one."""
    off = found - true
    return (np.hypot(off[:, 0], off[:, 1]) < 0.03) & (np.abs(se2.wrap_array(off[:, 2])) < 0.05)


@pytest.mark.parametrize(
    ("name", "tried", "first_least", "sure_least"),
    [("lamps", 120, 0.9, 0.3), ("grid", 120, 0.3, 0.0), ("small tiles", 30, 0.9, 0.6)],
)
def test_the_true_displacement_is_among_them_and_one_that_is_sure_is_right(
    name: str, tried: int, first_least: float, sure_least: float
) -> None:
    """The prior is as wrong as it says; a sure one may be wrong once in 1/RATE."""
    rng, sure, first = np.random.default_rng(5), 0, 0
    sigma = np.array([0.25, 0.25, 0.3])
    for k in range(tried):
        here = somewhere(rng)
        true = rng.normal(size=3) * np.array([0.4, 0.2, 0.4])
        views = camera(name, k % 3).sees(here, 2 * k), camera(name, k % 3).sees(se2.compose(here, true), 2 * k + 1)
        found = compared(*views, true + rng.normal(size=3) * sigma, sigma)
        right = is_at(found.ref_from_curr, true)
        assert np.count_nonzero(right) == 1
        first += bool(right[0])
        if found.doubt() < RATE:
            sure += 1
            assert right[0], f"{name}, pair {k}: sure of {found.ref_from_curr[0]}, but it was {true}"
    print(f"{name}: {sure} of {tried} sure and right, {first} right at first")
    assert first >= first_least * tried
    assert sure >= sure_least * tried


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), tiles=st.tuples(st.integers(-1, 1), st.integers(-1, 1)))
def test_on_a_bare_grid_whole_tiles_fit_alike_and_that_is_said(seed: int, tiles: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    here, true = somewhere(rng), rng.uniform(-0.25, 0.25, 3)
    seen = camera("grid", flawless=True)
    ref, curr = seen.sees(here, 1), seen.sees(se2.compose(here, true), 2)
    found = compared(ref, curr, true, np.array([0.4, 0.4, 0.05]))
    assert found.doubt() > 0.1
    axes = se2.rotation(-float(here[2]))  # of the grid, in base
    off = true + np.array([*(axes @ (TILE_M * np.array(tiles))), 0.0])
    at = is_at(found.ref_from_curr, off)
    assert np.count_nonzero(at) == 1
    assert abs(found.log_ratio[at][0] - found.log_ratio[is_at(found.ref_from_curr, true)][0]) < 2.0
    among = found.ref_from_curr[[0, *found.others(RATE)]]
    assert len(among) >= 5
    straight = np.abs(se2.wrap_array(among[:, 2] - true[2])) < 0.1
    whole = (among[straight, :2] - true[:2]) @ axes / TILE_M
    assert np.abs(whole - np.round(whole)).max() < 0.02


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_which_view_is_the_reference_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    here, true = somewhere(rng), rng.normal(size=3) * np.array([0.3, 0.3, 0.2])
    views = camera("lamps").sees(here, seed), camera("lamps").sees(se2.compose(here, true), seed + 1)
    sigma = np.array([0.3, 0.3, 0.3])
    there = compared(*views, true, sigma)
    back = compared(*views[::-1], se2.inverse(true), sigma)
    assert is_at(there.ref_from_curr, true).any() and is_at(back.ref_from_curr, se2.inverse(true)).any()
    if there.doubt() < 0.01 * RATE:
        assert is_at(back.ref_from_curr[:1], se2.inverse(true)).all()


def test_a_lamp_tells_tiles_apart_that_joints_do_not() -> None:
    """The same two places, with the lamps of the ceiling and without."""
    sigma = np.array([0.4, 0.4, 0.02])
    doubts = {}
    for name in ("grid", "lamps"):
        doubts[name] = []
        for k in range(20):
            rng = np.random.default_rng(900 + k)
            here, true = somewhere(rng), rng.uniform(-0.2, 0.2, 3)
            views = camera(name).sees(here, k), camera(name).sees(se2.compose(here, true), 100 + k)
            doubts[name].append(compared(*views, true, sigma).doubt())
    print({name: np.round(np.quantile(d, [0.1, 0.5, 0.9]), 6) for name, d in doubts.items()})
    assert np.median(doubts["lamps"]) < 0.01 < 0.3 < np.median(doubts["grid"])


def test_what_lies_beyond_the_view_has_its_share() -> None:
    """A robot that may be anywhere within 3 m is likely out of a view of 3 m by 2 m, whatever fits."""
    here = np.array([20.0, 20.0, 0.0])
    views = camera("grid").sees(here, 1), camera("grid").sees(here + np.array([3.1, 0.0, 0.0]), 2)
    wide, narrow = (compared(*views, np.zeros(3), np.array([s, s, 0.1])) for s in (3.0, 0.1))
    assert wide.log_elsewhere > np.log(0.5) and wide.doubt() > 0.5
    assert narrow.log_elsewhere < np.log(1e-9)


@pytest.mark.parametrize(
    ("step_m", "sigma_m", "by_a_tile", "turned"),
    [(0.012, 0.02, 10.0, 132.0), (0.001, 0.02, 1.0, 132.0), (0.012, 0.4, 1.0, 1.0)],
)
def test_a_robot_that_was_moved_would_not_see_tiles_just_where_they_were_foreseen(
    step_m: float, sigma_m: float, by_a_tile: float, turned: float
) -> None:
    """It would stand anywhere in a tile; but who tries localisers moves one that stands by whole tiles, so of those
    less is made. A vague prediction foresees no tiles."""
    here, true, third = np.array([20.0, 20.0, 0.0]), np.array([step_m, 0.0, 0.0]), np.array([0.2, 0.2, 0.0])
    ref, curr = (camera("grid", flawless=True).sees(at, k) for k, at in enumerate((here, se2.compose(here, true))))
    turn, cov = direction_change(ref.psi_rad, curr.psi_rad, 0.0), np.diag([sigma_m, sigma_m, 0.002]) ** 2
    share: dict[str, list[float]] = {"by a tile": [], "turned": []}
    for mean in (true, true + third):
        found = find_candidates(ref, curr, turn, Prior(mean, cov, 0.5, 0.033))
        of_hand = found.unpredicted * np.exp(found.log_weight - found.log_ratio)
        share["by a tile"].append(of_hand[is_at(found.ref_from_curr, np.add(true, [0.6, 0.0, 0.0]))][0])
        share["turned"].append(np.max(of_hand[np.abs(found.ref_from_curr[:, 2]) > 3.0]))
    for other, least in (("by a tile", by_a_tile), ("turned", turned)):
        less = share[other][1] / share[other][0]
        print(f"{1e3 * sigma_m:.0f} mm, {other}: {less:.1f} times as likely where tiles are not foreseen")
        assert 0.9 * least < less < 1.1 * least


def test_the_chance_of_being_carried_brings_in_what_the_prediction_excludes() -> None:
    """A tile further than the prediction allows: the lamps say so, the prior by how much they must."""
    here, true, seen = (
        np.array([20.0, 20.0, 0.3]),
        np.array([0.6 * np.cos(-0.3), 0.6 * np.sin(-0.3), 0.0]),
        camera("lamps"),
    )
    views = seen.sees(here, 1), seen.sees(se2.compose(here, true), 2)
    sigma = np.array([0.002, 0.002, 0.004])
    trusting, doubting = (compared(*views, np.zeros(3), sigma, carried) for carried in (1e-4, 1e-2))
    assert is_at(doubting.ref_from_curr[:1], true).all()
    at = is_at(doubting.ref_from_curr, true)
    assert doubting.log_ratio[at][0] > doubting.log_ratio[is_at(doubting.ref_from_curr, np.zeros(3))][0] + 3.0
    shares = []
    for found in (trusting, doubting):
        k = np.flatnonzero(is_at(found.ref_from_curr, true))[0]
        shares.append(found.log_weight[k] - found.log_ratio[k])
    assert shares[0] - shares[1] == pytest.approx(np.log(1e-4 / 1e-2), abs=0.01)


@pytest.mark.parametrize("name", ["lamps", "grid"])
def test_after_a_view_that_fitted_nothing_the_next_one_tells_whether_somebody_moved_the_robot(name: str) -> None:
    """As likely as not it was moved, by a tile or two or anywhere: the lamps tell, bare tiles do not."""
    sigma, stayed, moved = np.array([0.003, 0.003, 0.004]), [], []
    for k in range(60):
        rng = np.random.default_rng(1900 + k)
        here, way = somewhere(rng), np.array([0.02, 0.0, 0.01])
        axes = se2.rotation(-float(here[2]))  # of the grid, in base
        tiles = rng.permutation(np.array([[1, 0], [0, -1], [-1, 1], [2, 0], [0, 2]]))[0]
        by_hand = np.array([*(way[:2] + axes @ (TILE_M * tiles)), way[2]]) if k % 3 else rng.normal(size=3)
        for true, chances in ((way, stayed), (by_hand, moved)):
            views = camera(name).sees(here, k), camera(name).sees(se2.compose(here, true), 100 + k)
            chances.append(compared(*views, way, sigma, carried=0.5).carried())
    print(name, "stayed", np.quantile(stayed, [0.1, 0.5, 0.9]), "moved", np.quantile(moved, [0.0, 0.02, 0.1, 0.5]))
    assert min(moved) > 0.5 > UNLIKELY
    if name == "lamps":
        assert np.median(stayed) < 0.05
    else:
        assert np.median(stayed) > 0.1


def test_cells_of_a_tenth_of_a_metre_are_not_taken_for_each_other_in_a_motion_that_is_foreseen() -> None:
    """Any cell explains the view as well; the prediction knows better by thirty of its standard deviations."""
    grid = np.stack(np.meshgrid(0.1 * np.arange(-16, 16), 0.1 * np.arange(-12, 12)), -1).reshape(-1, 2)
    none = np.zeros((len(grid), 2, 2)), np.zeros(len(grid), np.int64)
    ref, curr = (Crossings(xy, xy, *none, 0.0, 0.0, np.zeros(2), np.zeros(2), np.zeros((2, 2))) for xy in (grid, grid))
    true = np.zeros(3)
    found, vague = (compared(ref, curr, true, np.array([s, s, 0.001]), carried=3e-6) for s in (0.003, 0.1))
    assert is_at(found.ref_from_curr[:1], true)[0]
    assert len(vague) > 4 and found.doubt() < 1e-5  # and who moved the robot is 3e-6


def test_what_a_view_misses_seldom_makes_a_wrong_displacement_likelier() -> None:
    """Both views miss some, and one may miss a line: counted by either view, that speaks of no other place."""
    rng, ahead = np.random.default_rng(12), []
    for k in range(300):
        here, true = somewhere(rng), rng.normal(size=3) * np.array([0.15, 0.1, 0.1])
        views = (
            camera("lamps", k % 3).sees(here, 2 * k),
            camera("lamps", k % 3).sees(se2.compose(here, true), 2 * k + 1),
        )
        found = compared(*views, true, np.array([1.5, 1.5, 0.01]))
        right = is_at(found.ref_from_curr, true)
        ahead.append(found.log_ratio[right][0] - np.max(found.log_ratio[~right], initial=-30.0))
    told, misled = np.count_nonzero(np.array(ahead) > 9.0), np.count_nonzero(np.array(ahead) < -3.0)
    print(f"{told} of 300 pairs tell by e^9 where they are, {misled} mislead by e^3 or more (seed 12)")
    assert told >= 110
    assert misled <= 6


def test_an_earlier_view_shows_what_the_reference_missed() -> None:
    """In doubt the mean of both counts; it tells nearly as much in the mean, and misleads less."""
    rng, ahead = np.random.default_rng(13), []
    for k in range(300):
        here, true = somewhere(rng), rng.normal(size=3) * np.array([0.15, 0.1, 0.1])
        back = rng.uniform(-0.3, 0.3, 3)
        seen = flickering(k % 3)
        ref, curr = seen.sees(here, 3 * k), seen.sees(se2.compose(here, true), 3 * k + 1)
        earlier = seen.sees(se2.compose(here, se2.inverse(back)), 3 * k + 2)
        prior = Prior(true, np.diag([1.5, 1.5, 0.01]) ** 2, 1e-4)
        one = compared(ref, curr, true, np.array([1.5, 1.5, 0.01]))
        pair = []
        for found in (one, by_two_views(one, earlier, back, curr, prior)):
            assert np.all(np.diff(found.log_weight) <= 0.0)
            right = is_at(found.ref_from_curr, true)
            pair.append(found.log_ratio[right][0] - np.max(found.log_ratio[~right], initial=-30.0))
        ahead.append(pair)
    misled, mean = np.count_nonzero(np.array(ahead) < -3.0, axis=0), np.mean(ahead, axis=0)
    print(f"of 300 pairs {misled} mislead by e^3, by one view and by two; the right place leads by e^{mean} (seed 13)")
    assert misled[1] < 0.75 * misled[0]
    assert mean[1] > 0.9 * mean[0]


@pytest.mark.parametrize("turned", [0.3, 0.0])
def test_an_earlier_view_of_another_ceiling_leaves_a_doubt_that_is_a_number(turned: float) -> None:
    """Lines of its own direction, or none of the crossings: it may say nothing, but no displacement is lost for it."""
    here, true = np.array([20.0, 20.0, 0.3]), np.array([0.05, 0.0, 0.02])
    ref, curr = camera("lamps").sees(here, 1), camera("lamps").sees(se2.compose(here, true), 2)
    found = compared(ref, curr, true, np.array([0.4, 0.4, 0.02]))
    if turned:
        other = replace(ref, psi_rad=ref.psi_rad + turned)
    else:
        other = replace(ref.of(np.arange(12)), xy_base_m=np.random.default_rng(3).uniform(-1.0, 1.0, (12, 2)))
    again = by_two_views(found, other, np.zeros(3), curr, Prior(true, np.diag([0.4, 0.4, 0.02]) ** 2, 1e-4))
    print(f"turned {turned}: doubt {found.doubt():.2g} -> {again.doubt():.2g}")
    assert len(again) == len(found) and np.all(np.isfinite(again.log_weight)) and 0.0 <= again.doubt() <= 1.0


def test_the_earlier_view_is_some_way_back_and_moves_on() -> None:
    views, kept, at = [camera("grid").sees(np.array([20.0, 20.0, 0.0]), k) for k in range(12)], EarlierView(), []
    for k, view in enumerate(views):
        kept = kept.then(np.array([0.06, 0.0, 0.0]), np.zeros((3, 3)), view)
        if kept.crossings is not None:
            back = next(k - n for n, seen in enumerate(views) if seen is kept.crossings)
            at.append(float(kept.at[0]))
            assert kept.at[0] == pytest.approx(0.06 * back)
    assert len(at) >= 8 and min(at) > APART and max(at) < 2.0 * APART + 0.06 + 1e-9
