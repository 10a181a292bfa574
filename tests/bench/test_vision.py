"""The vision bench's own figures: what it must say of results made by hand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceilvo import se2
from ceilvo.bench.vision import command as vision
from ceilvo.bench.vision.baselines import DescriptorMatcher, PointTracker
from ceilvo.bench.vision.condition import LAP
from ceilvo.bench.vision.conditions import conditions, misjudged
from ceilvo.bench.vision.metrics import CrossingScore, MotionScore
from ceilvo.bench.vision.run import Options, run
from ceilvo.sim.ceiling.layout import CrossingType
from ceilvo.sim.motion import TiltSpec
from ceilvo.sim.world import World, WorldSpec
from ceilvo.types import Crossings, Motion

TILT = np.array([0.03, -0.02])


@pytest.fixture(scope="module")
def world() -> World:
    return World(WorldSpec(tilt=TiltSpec(0.035)))


def crossings(uv: np.ndarray) -> Crossings:
    n, z = len(uv), np.zeros(2)
    return Crossings(uv, np.zeros((n, 2)), np.zeros((n, 2, 2)), np.zeros(n, np.int64), 0.0, 0.0, z, z, np.zeros((2, 2)))


def level(world: World, xy_map: np.ndarray, pose: np.ndarray) -> np.ndarray:
    base = se2.transform(se2.inverse(pose), xy_map)
    s = np.column_stack([base, np.ones(len(base))]) @ world.calibration.level_from_ceiling.T
    return s[:, :2] / s[:, 2:]


def truth(world: World, pose: np.ndarray) -> np.ndarray:
    xy, kind = world.ceiling.true_crossings()
    near = np.hypot(*(xy - pose[:2]).T) < 3.0
    return level(world, xy[near & (kind != CrossingType.VENT)], pose)


def test_perfect_crossings_score_full_marks(world: World) -> None:
    score, pose = CrossingScore(world, world.calibration), world.truth_at(5.0)
    score.add(crossings(truth(world, pose)), pose, TILT)
    f = score.figures()
    assert f["recall_pct"] == f["precision_pct"] == 100.0
    assert f["crossing_p95_px"] < 1e-6
    assert 15 < f["crossings_true_per_frame"] < 60


def test_shifted_missing_and_invented_crossings_show(world: World) -> None:
    score, pose = CrossingScore(world, world.calibration), world.truth_at(5.0)
    uv = truth(world, pose)
    score.add(crossings(uv + np.array([0.3, 0.4])), pose, TILT)
    assert abs(score.figures()["crossing_median_px"] - 0.5) < 1e-6
    score.add(None, pose, TILT)
    assert score.figures()["recall_pct"] == 50.0
    # the middles of tiles are on no line
    invented = CrossingScore(world, world.calibration)
    invented.add(crossings(np.concatenate([uv, uv + np.array([55.0, 55.0])])), pose, TILT)
    assert 30.0 < invented.figures()["precision_pct"] < 80.0


def test_true_crossings_are_dark_in_the_picture_of_a_tilted_robot(world: World) -> None:
    """The tilt's sign and the projection, against the renderer."""
    pose = world.truth_at(5.0)
    score = CrossingScore(world, world.calibration)
    shown = score._visible(pose, TILT)
    image = world.renderer.render(pose, np.random.default_rng(1), TILT).astype(np.float32)
    base = se2.transform(se2.inverse(pose), score._true[shown & ~score._is_lamp]) - world.calibration.mount_xy_m
    ray = np.column_stack([base, np.full(len(base), world.calibration.ceiling_height_m)])
    seen = ray @ cv2.Rodrigues(np.array([*TILT, 0.0]))[0]
    uv = world.calibration.camera.pixels(seen @ world.calibration.camera_from_base.T).astype(np.float32)
    assert len(uv) > 10
    assert (uv > 10).all()
    here = cv2.remap(image, uv[None], None, cv2.INTER_LINEAR)[0]
    away = cv2.remap(image, uv[None] + np.float32(12.0), None, cv2.INTER_LINEAR)[0]
    assert (here < 0.75 * away).mean() > 0.9


def good(motion: np.ndarray, sigma: float = 1e-3) -> Motion:
    return Motion(motion, np.diag([sigma**2] * 3), 10, 0.0)


FIRST = Motion(np.zeros(3), np.eye(3), 5, 0.0, "first frame", restarted=True)
STEP = np.array([0.01, 0.0, 0.02])


def drive(n: int) -> list[np.ndarray]:
    poses = [np.array([1.0, 2.0, 0.5])]
    for _ in range(n):
        poses.append(se2.compose(poses[-1], STEP))
    return poses


def test_true_motions_have_no_error_and_no_failure() -> None:
    true = drive(20)
    score = MotionScore(true[0])
    for motion, pose in zip([FIRST] + [good(STEP)] * 20, true, strict=True):
        score.add(motion, pose)
    f = score.figures(0.2)
    assert f["worst_mm"] < 1e-9
    assert f["failed"] == f["wrong"] == f["restarts"] == 0
    assert f["motion_p95_mm"] < 1e-9


def test_a_gap_that_the_next_motion_makes_good_is_a_failure_but_not_wrong() -> None:
    true = drive(4)
    lost = Motion(np.zeros(3), np.eye(3), 0, 0.0, "dark")
    catching_up = good(se2.between(np.zeros(3), se2.compose(se2.compose(STEP, STEP), STEP)))
    score = MotionScore(true[0])
    for motion, pose in zip([FIRST, lost, lost, catching_up, good(STEP)], true, strict=True):
        score.add(motion, pose)
    f = score.figures(0.04)
    assert f["failed"] == 2
    assert f["wrong"] == 0
    assert f["final_mm"] < 1e-9 < 15.0 < f["worst_mm"], "during the gap the position was old"


def test_a_wrong_motion_called_good_is_counted_and_a_restart_is_not_called_wrong() -> None:
    true = drive(4)
    restart = Motion(np.zeros(3), np.eye(3), 0, 0.0, "too far", restarted=True)
    score = MotionScore(true[0])
    for motion, pose in zip(
        [FIRST, good(STEP + np.array([0.6, 0.0, 0.0])), good(STEP), restart, good(STEP)], true, strict=True
    ):
        score.add(motion, pose)
    f = score.figures(0.04)
    assert f["wrong"] == 1
    assert f["restarts"] == 1
    assert score.wrong_at == [1]
    assert f["worst_mm"] > 590


def test_nees_of_honest_noise_is_one() -> None:
    rng = np.random.default_rng(3)
    true = drive(3000)
    score = MotionScore(true[0])
    score.add(FIRST, true[0])
    for pose in true[1:]:
        score.add(good(STEP + rng.normal(0.0, 1e-3, 3)), pose)
    f = score.figures(30.0)
    assert abs(f["nees_mean"] - 1.0) < 0.06
    assert abs(f["nees_median"] - 1.0) < 0.08


@pytest.mark.parametrize("method", [PointTracker, DescriptorMatcher])
def test_baselines_follow_a_clean_straight(method: type, world: World) -> None:
    still = World(WorldSpec())
    rival = method(still.calibration)
    times = 4.0 + np.arange(8) / 30.0
    moves = [rival.step(still.frame_at(t)) for t in times][1:]
    total = np.zeros(3)
    for m in moves:
        total = se2.compose(total, m)
    expected = se2.between(still.truth_at(times[0]), still.truth_at(times[-1]))
    assert np.hypot(*(total - expected)[:2]) < 0.008
    assert rival.step(np.zeros((480, 640), np.uint8)).shape == (3,), "darkness does no harm"


def test_conditions_are_those_of_the_bench_and_their_bars_have_figures() -> None:
    all_of_them = conditions()
    names = [c.name for c in all_of_them]
    assert len(set(names)) == len(names) >= 25
    columns = {name for _, parts in vision.COLUMNS for name, _ in parts}
    for c in all_of_them:
        assert set(c.bars) <= columns | {"restarts"}, c.name
    lap_m = World(WorldSpec(lap=LAP)).path.lap_m
    assert abs(lap_m - 19.0) < 0.2


def test_misjudged_calibrations_differ_as_asked() -> None:
    true, wrong = misjudged(), misjudged(1.05, 1.005, 2.0)
    assert wrong.camera.distortion[0] == pytest.approx(1.05 * true.camera.distortion[0])
    assert wrong.camera.fx_px == pytest.approx(1.005 * true.camera.fx_px)
    assert wrong.camera.cx_px == pytest.approx(true.camera.cx_px + 2.0)
    assert wrong.ceiling_height_m == pytest.approx(true.ceiling_height_m)
    np.testing.assert_allclose(wrong.camera_from_base, true.camera_from_base, atol=1e-9)


def test_one_run_fills_table_json_and_picture(tmp_path: Path) -> None:
    base = conditions()[0]
    figures = run(base, Options(seconds=0.5, pictures=tmp_path))
    assert figures["frames"] == 15
    assert figures["recall_grid_pct"] > 95.0
    assert figures["klt_time"] > 0 < figures["time_median"]
    assert cv2.imread(str(tmp_path / "base.png")) is not None
    written = json.loads(json.dumps(vision.as_json([base], [figures], 0.5), allow_nan=False))
    assert set(written["conditions"]["base"]["bars"]) == set(base.bars) - {"gap_nees"}, "there was no gap"
    assert vision.table([base], [figures]).row_count == 1


def test_figures_that_are_not_numbers_never_meet_a_bar() -> None:
    for bar in conditions()[0].bars.values():
        assert not bar.met(math.nan)


def test_a_seed_draws_every_condition_anew_and_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The conditions that run in processes of their own are drawn with it, too."""
    assert {c.spec.seed for c in vision._chosen(None, 61)} == {61}
    ran = []
    monkeypatch.setattr(vision, "run", lambda condition, options, progress: ran.append(condition) or {})
    vision._job(vision._chosen("tilt", 61)[0], Options())
    assert [(c.name, c.spec.seed) for c in ran] == [("tilt", 61)]
    usual, other = (vision._chosen("base", seed)[0].world() for seed in (1, 61))
    assert not np.array_equal(usual.frame_at(0.0), other.frame_at(0.0))
    monkeypatch.setattr(vision, "_run_all", lambda chosen, options, jobs: [{} for _ in chosen])
    for arguments, seed in (([], 1), (["--seed", "61"], 61)):
        assert vision.main(["--conditions", "base,tilt", "--json", str(tmp_path / "a.json"), *arguments]) == 0
        told = json.loads((tmp_path / "a.json").read_text())["conditions"]
        assert [c["seed"] for c in told.values()] == [seed, seed]


def test_an_unknown_condition_is_one_line_that_lists_the_known(capsys: pytest.CaptureFixture[str]) -> None:
    assert vision.main(["--conditions", "bsae"]) != 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "no 'bsae'" in said
    assert "walls" in said
