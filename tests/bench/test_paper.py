"""The paper bench itself: its world has the noise it states, its statistics are right, resuming changes nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

import ceilvo.daemon
from ceilvo.bench.paper import command as paper
from ceilvo.bench.paper import tables as paper_tables
from ceilvo.bench.paper.ekf import EkfNearestNeighbour
from ceilvo.bench.paper.filters import redraw_without_curve
from ceilvo.bench.paper.run import Cell, labels_of, longest, mapping, on_a_map, run
from ceilvo.bench.paper.stats import mean_interval, ratio_interval
from ceilvo.bench.paper.world import (
    DT_S,
    KIDNAP_M,
    LAP_STEPS,
    ROOM_M,
    SETTINGS,
    SPEED_M_S,
    VIEW_M,
    grid_scene,
    lap_start,
    lap_steps,
    record,
    room_scene,
)
from ceilvo.bench.results.bars import Bar
from ceilvo.bench.results.store import Store, rooms, run_all
from ceilvo.se2 import compose, inverse, transform, wrap
from ceilvo.tasks.workers import Workers
from ceilvo.types import Landmarks

SEED = 20


def recorded(setting, steps=LAP_STEPS, seed=SEED, **more):
    rng = np.random.default_rng(seed)
    return record(setting, room_scene(rng), rng, steps, **more)


def test_a_lap_closes_at_the_stated_speed_inside_the_room():
    pose, way, path = lap_start(), 0.0, []
    for step in lap_steps():
        pose = compose(pose, step)
        way += float(np.hypot(*step[:2]))
        path.append(pose)
    assert np.allclose(pose[:2], lap_start()[:2], atol=1e-9)
    assert abs(wrap(pose[2])) < 1e-9
    assert way == pytest.approx(LAP_STEPS * SPEED_M_S * DT_S, rel=5e-3)  # chords of arcs
    assert np.all((np.array(path)[:, :2] > 0.0) & (np.array(path)[:, :2] < ROOM_M))


@pytest.mark.parametrize("name", ["P", "S0", "S1"])
def test_observations_have_the_stated_noise(name):
    world = SETTINGS[name]
    recording = recorded(world, 10 * LAP_STEPS)
    u, h = [], []
    for step in recording.steps:
        at = transform(inverse(step.truth), recording.scene.xy_m)[step.seen]
        u.append((step.xy_base_m - at) / world.sigma(np.hypot(*at.T))[:, None])
        h.append(wrap(step.heading_rad - step.truth[2]))
    u = np.concatenate(u)
    wrong = np.mean(np.hypot(*u.T) > 4.5)  # of a clean one: exp(-10)
    spread = np.median(np.abs(u)) / 0.6745
    print(f"{name}: {len(u)} observations, seed {SEED}: spread {spread:.3f} sigma, {wrong:.2%} beyond 4.5 sigma")
    assert abs(np.mean(np.median(u, axis=0))) < 0.03
    assert 0.97 < spread < 1.05
    assert wrong < world.outlier_share + 0.01
    assert (wrong < 1e-3) if not world.outlier_share else (wrong > 0.4 * world.outlier_share)
    assert np.std(h) == pytest.approx(world.sigma_theta_rad, rel=0.06)


def test_odometry_has_the_stated_noise_and_slips_as_often():
    world = SETTINGS["S1"]
    recording = recorded(world, 20 * LAP_STEPS)
    way, begun, before = SPEED_M_S * DT_S, 0, False
    noise = []
    truth = [recording.start, *(s.truth for s in recording.steps)]
    for last, step in zip(truth, recording.steps, strict=False):
        moved = compose(inverse(last), step.truth)
        slips = step.reported[0] > 1.33 * moved[0]
        begun += slips and not before
        before = slips
        if not slips:
            noise.append((step.reported - moved) / way)
    expected = 20 * LAP_STEPS * way * world.slip_per_m
    print(f"seed {SEED}: {begun} slips, {expected:.0f} expected; odometry {np.std(noise, axis=0)} per metre")
    assert abs(begun - expected) < 4 * np.sqrt(expected)
    assert np.std(noise, axis=0) == pytest.approx(
        [world.forward_m_per_m, world.lateral_m_per_m, world.heading_rad_per_m], rel=0.06
    )


def test_filters_are_told_the_noise_that_the_setting_says():
    for world in SETTINGS.values():
        step = recorded(world, 5).steps[-1]
        sigma = world.sigma(np.hypot(*step.xy_base_m.T))
        assert np.allclose(step.sigma_m, world.assumed * sigma)
        length = SPEED_M_S * DT_S
        assert np.sqrt(step.reported_cov[0, 0]) == pytest.approx(
            world.assumed * world.forward_m_per_m * length, rel=1e-2
        )


def test_only_what_is_in_the_view_is_seen_and_a_kidnap_is_not_in_the_odometry():
    recording = recorded(SETTINGS["S0"], 30, kidnapped=10)
    for step in recording.steps:
        far = np.hypot(*(recording.scene.xy_m - step.truth[:2]).T)
        assert set(step.seen) == set(np.flatnonzero(far < VIEW_M))
    a, b = recording.steps[9].truth, recording.steps[10]
    jump = compose(inverse(compose(a, lap_steps()[10])), b.truth)
    assert np.hypot(*jump[:2]) == pytest.approx(KIDNAP_M, rel=1e-6)
    assert np.hypot(*b.reported[:2]) < 0.2


def test_the_same_seed_is_the_same_recording_and_another_is_not():
    a, b, c = (recorded(SETTINGS["P"], 20, seed).steps[-1].reported for seed in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, c)


def test_the_grid_is_periodic_and_lamps_are_in_the_middle_of_tiles():
    scene = grid_scene(np.random.default_rng(1), True)
    crossings = scene.xy_m[scene.kind == 0]
    phase = (crossings - crossings[0]) / 0.6
    assert np.allclose(phase, np.round(phase))
    others = (scene.xy_m[scene.kind > 0] - crossings[0]) / 0.6 - 0.5
    assert len(others) > 5
    assert np.allclose(others, np.round(others))


# -- statistics


def test_bootstrap_agrees_with_the_normal_interval_of_a_known_mean():
    values = np.random.default_rng(3).normal(2.0, 0.5, 400)
    found = mean_interval(values)
    half = 1.96 * np.std(values, ddof=1) / np.sqrt(400)
    assert found.value == pytest.approx(np.mean(values))
    assert found.high - found.value == pytest.approx(half, rel=0.1)
    assert found.value - found.low == pytest.approx(half, rel=0.1)


def test_pairing_takes_out_what_the_seeds_share():
    rng = np.random.default_rng(4)
    hard = rng.uniform(0.5, 2.0, 60)
    a, b = 0.9 * hard * rng.normal(1, 0.01, 60), hard * rng.normal(1, 0.01, 60)
    paired, shuffled = ratio_interval(a, b), ratio_interval(rng.permutation(a), b)
    assert paired.low < 0.9 < paired.high
    assert paired.high - paired.low < 0.1 * (shuffled.high - shuffled.low)


def test_the_interval_covers_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(5)
    hits = 0
    for _ in range(120):
        i = ratio_interval(rng.gamma(4.0, 0.25, 50), rng.gamma(4.0, 0.25, 50))
        hits += i.low <= 1.0 <= i.high
    print(f"seed 5: {hits} of 120 intervals cover the ratio 1")
    assert 104 <= hits <= 120


def test_ratios_of_unequal_counts_are_refused():
    with pytest.raises(ValueError, match="as many of both"):
        ratio_interval(np.ones(3), np.ones(4))


def test_bars_have_their_ends_inside():
    assert Bar("x", 1.0, "", high=1.0).met
    assert not Bar("x", 1.001, "", high=1.0).met
    assert not Bar("x", float("nan"), "", high=1.0).met
    assert Bar("x", 2.0, "", 1.4, 2.8).wanted == "1.4 to 2.8"


# -- filters of the bench


def test_the_control_keeps_the_weighted_moments():
    rng = np.random.default_rng(6)
    poses = rng.normal(0, [0.1, 0.2, 0.05], (20000, 3))
    weights = np.exp(-0.5 * ((poses[:, 0] - 0.1) / 0.1) ** 2)
    weights /= weights.sum()
    drawn, _ = redraw_without_curve(poses, weights, 4, rng)
    assert np.allclose(drawn.mean(axis=0), weights @ poses, atol=2e-3)
    assert np.std(drawn[:, 0]) == pytest.approx(0.1 / np.sqrt(2), rel=0.03)


def test_the_ekf_maps_a_grid_without_labels_and_is_consistent():
    rng = np.random.default_rng(7)
    figures = mapping(EkfNearestNeighbour(), record(SETTINGS["S0"], grid_scene(rng, False), rng, 60), labelled=False)
    print(f"seed 7: {figures['position_rms_m']:.3f} m, NEES {figures['position_nees_mean']:.2f}")
    assert figures["position_end_m"] < 0.25
    assert 0.2 < figures["position_nees_mean"] < 8.0


def test_labels_follow_identities_and_the_longest_run_is_counted():
    m = Landmarks(np.arange(3), np.zeros((3, 2)), np.zeros((3, 2, 2)), np.array([5, 9, 5]), np.ones(3, int))
    assert list(labels_of(np.array([9, 5, 4]), m)) == [1, 0, -1]
    assert longest([True, True, False, True]) == 2


def test_a_wrong_pose_that_is_called_tracking_is_found_out():
    class Sleeper(EkfNearestNeighbour):
        """Sure of itself, and blind."""

        def update(self, obs):
            self._nis, self._dof = 1.0, 2 * len(obs)

    rng = np.random.default_rng(8)
    world = replace(SETTINGS["S0"], forward_m_per_m=1e-3, lateral_m_per_m=1e-3, heading_rad_per_m=1e-3)
    scene = grid_scene(rng, True)
    figures = on_a_map(Sleeper(), record(world, scene, rng, 60, kidnapped=20), anywhere=False)
    assert figures["recovered_s"] == float("inf")
    assert figures["wrong_tracking_s"] > 5.0


# -- storing and resuming


def figures_of(cell):
    return {"x": float(np.random.default_rng([cell.seed, cell.particles]).random())}


def cell(seed, n=20):
    return Cell("lap", "P", "pf", n, seed)


def test_resuming_equals_running_at_once(tmp_path):
    cells = [cell(s, n) for s in range(5) for n in (20, 50)]

    def stored(name, parts):
        for part in parts:
            store = Store(tmp_path / name, "f", lambda k: Cell(**k))
            run_all(store, part, asdict, figures_of, Workers())
        return store.results

    assert stored("once", [cells]) == stored("twice", [cells[:3], cells])
    assert len((tmp_path / "twice").read_text().splitlines()) == len(cells)


def test_a_line_cut_short_and_other_code_are_run_again(tmp_path):
    path = tmp_path / "x.jsonl"
    store = Store(path, "a", lambda k: Cell(**k))
    store.add(cell(1), asdict(cell(1)), {"x": 1.0})
    store.add(cell(2), asdict(cell(2)), {"x": 2.0})
    path.write_text(path.read_text()[:-9])
    assert set(Store(path, "a", lambda k: Cell(**k)).results) == {cell(1)}
    assert not Store(path, "b", lambda k: Cell(**k)).results
    again = Store(path, "a", lambda k: Cell(**k))
    again.add(cell(3), asdict(cell(3)), {"x": 3.0})
    assert set(Store(path, "a", lambda k: Cell(**k)).results) == {cell(1), cell(3)}


def test_a_cell_is_repeatable():
    one = Cell("lap", "S0", "pf", 20, 3)
    a, b = run(one), run(one)
    assert {k: v for k, v in a.items() if k != "us_per_step"} == {k: v for k, v in b.items() if k != "us_per_step"}


def test_who_wins_is_read_off_the_figures():
    results = {}
    for seed in range(30):
        for name, error in (("pf", 0.10), ("joint", 0.08), ("ukf_gated", 0.07)):
            figures = {"position_rms_m": error * (1 + 0.01 * seed), "feature_rms_m": error, "position_nees": [1.4]}
            results[Cell("lap", "P", name, 0 if name == "ukf_gated" else 20, seed)] = figures
    text = "\n".join(paper_tables.verdicts(results))
    assert "P, position: ukf_gated is best" in text
    assert "joint beats pf: ratio 0.800" in text
    assert "joint loses to ukf_gated" in text
    found = {b.name: b.verdict for b in paper_tables.ratio_bars(results)}
    assert found["P: joint / pf, position"] == "PASS"
    assert found["P: joint / ukf_gated, position"] == "MISS"


def test_smoke(tmp_path, capsys):
    out = tmp_path / "paper.json"
    arguments = ["--seeds", "1", "--experiments", "lap", "--settings", "P", "--particles", "20", "--no-pictures"]
    assert paper.main([*arguments, "--filters", "pf,ukf_gated", "--json", str(out)]) == 0
    document = json.loads(out.read_text())
    assert {r["filter"] for r in document["table1"]["lap P"]} == {"pf", "ukf_gated"}
    assert document["settings"]["noise"]["P"]["slip_per_m"] == 0.08
    assert "Table 1, P" in capsys.readouterr().out


def test_a_wrong_name_is_one_line(capsys):
    assert paper.main(["--filters", "kalman"]) != 0
    assert "no 'kalman'; known are ukf" in capsys.readouterr().err


def test_the_fingerprint_covers_all_that_filters_and_states_load():
    """Against what an interpreter has loaded after importing them."""
    code = "import sys, ceilvo.daemon.relocalisation.filters, ceilvo.daemon.integrity.states\n"
    code += "print(*(m.__file__ for n, m in sys.modules.items() if n.startswith('ceilvo.daemon.')))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert len(loaded) > 10
    assert {Path(file) for file in loaded} <= set(rooms(Path(ceilvo.daemon.__path__[0])))
