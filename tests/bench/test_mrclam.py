"""The recorded-robots bench: the reader on a tiny synthetic set, the noise fit against known noise, smoke."""

from __future__ import annotations

import gzip
import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from ceilvo.bench.mrclam import command as mrclam
from ceilvo.bench.mrclam import noise as mrclam_noise
from ceilvo.bench.mrclam import run as mrclam_run
from ceilvo.bench.mrclam.data import arc, read_run, read_world, robots_in
from ceilvo.bench.mrclam.noise import Bias, Noise, bias_of, fit, odometry_errors, residuals, without
from ceilvo.errors import FileFormatError
from ceilvo.se2 import compose, wrap

LANDMARKS = np.array([[0.0, -3.0], [3.0, 0.0], [0.0, 3.0], [-3.0, 0.0], [2.5, 2.5]])
RANGE, BEARING = (0.02, 0.03), 0.02


def write(folder, name, rows, zipped=False):
    text = "# comment\n" + "\n".join(" ".join(f"{x:.6f}" for x in row) for row in rows) + "\n"
    if zipped:
        (folder / f"{name}.gz").write_bytes(gzip.compress(text.encode()))
    else:
        (folder / name).write_text(text)


def drive(robot, seconds, rng):
    """A circle of 1.5 m, with the stated noise; all landmarks are seen every second."""
    dt, v, w = 0.05, 0.3, 0.2
    t = 1000.0 + dt * np.arange(round(seconds / dt))
    poses = [np.array([0.0, -1.5, 0.1 * robot])]
    for _ in t[1:]:
        poses.append(compose(poses[-1], arc(np.array([v]), np.array([w]), np.array([dt]))[0]))
    poses = np.array(poses)
    told = np.column_stack([t, v + 0.02 * rng.standard_normal(len(t)), w + 0.02 * rng.standard_normal(len(t))])
    seen = []
    for i in range(0, len(t), 20):
        d = LANDMARKS - poses[i, :2]
        r = np.hypot(*d.T)
        far = r + (RANGE[0] + RANGE[1] * r) * rng.standard_normal(len(r))
        b = np.arctan2(d[:, 1], d[:, 0]) - poses[i, 2] + BEARING * rng.standard_normal(len(r))
        seen += [(t[i], 10 + k, far[k], wrap(float(b[k]))) for k in range(len(r))]
    seen.append((t[-1], 99, 1.0, 0.0))  # no such barcode
    seen.append((t[-1], 3, 1.0, 0.0))  # a robot
    return told, np.column_stack([t, poses]), np.array(seen)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("set")
    rng = np.random.default_rng(9)
    write(out, "Landmark_Groundtruth.dat", [(6 + k, *xy, 0.0, 0.0) for k, xy in enumerate(LANDMARKS)], zipped=True)
    write(out, "Barcodes.dat", [(1, 1), (2, 2), (3, 3), *((6 + k, 10 + k) for k in range(len(LANDMARKS)))])
    for robot in (1, 2):
        told, truth, seen = drive(robot, 150.0, rng)
        write(out, f"Robot{robot}_Odometry.dat", told, zipped=robot == 2)
        write(out, f"Robot{robot}_Groundtruth.dat", truth)
        write(out, f"Robot{robot}_Measurement.dat", seen[::-1])  # the reader puts them in order
    return out


def test_the_reader_understands_barcodes_order_and_gzip(folder):
    world = read_world(folder)
    assert robots_in(folder) == [1, 2]
    run = read_run(folder, 2, world)
    assert np.all(np.diff(run.seen_s) >= 0)
    assert set(run.subject) == {6, 7, 8, 9, 10}
    assert run.ignored == {"unknown_barcode": 1, "not_a_landmark": 1, "outside_time": 0, "not_sane": 0}
    truth = run.truth_at(np.array([1010.025]))
    assert np.all(np.isfinite(truth))
    assert np.all(np.isnan(run.truth_at(np.array([10.0]))))


def test_dead_reckoning_is_the_circle_that_was_driven(tmp_path, folder):
    run = read_run(folder, 1, read_world(folder))
    run.odometry[:, 1:] = [0.3, 0.2]
    t = run.odometry[[0, 500, 1000], 0] + 0.01
    angle = 0.2 * (t - t[0] + 0.01)
    expected = 1.5 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    assert np.allclose(run.dead_reckoning(t)[:, :2], expected, atol=1e-6)


def test_a_gap_in_the_truth_is_not_bridged(folder):
    run = read_run(folder, 1, read_world(folder))
    t = run.truth[:, 0]
    gap = run.truth[(t < 1020.0) | (t > 1023.0)]
    object.__setattr__(run, "truth", gap)
    assert np.all(np.isnan(run.truth_at(np.array([1021.5]))))
    assert np.all(np.isfinite(run.truth_at(np.array([1019.0, 1024.0]))))


def test_the_fit_finds_the_noise_that_is_there(folder):
    world = read_world(folder)
    noise = fit([read_run(folder, r, world) for r in (1, 2)], world)
    r = np.array([1.5, 3.0, 4.5])
    along, across = noise.sigmas(r)
    print(f"seed 9: range {along} m, expected {RANGE[0] + RANGE[1] * r}; bearing {across} rad, expected {BEARING}")
    assert along == pytest.approx(RANGE[0] + RANGE[1] * r, rel=0.15)
    assert across == pytest.approx(np.full(3, BEARING), rel=0.15)
    motion, error, _ = odometry_errors([read_run(folder, 1, world)])
    cov = np.diagonal(noise.motion_cov(motion[0], 1.0))
    assert np.sqrt(cov[[0, 2]]) == pytest.approx(np.std(error, axis=0)[[0, 2]], rel=0.35)


def test_bias_is_found_and_taken_out(folder):
    world = read_world(folder)
    share, late_s, factor = np.array([0.04, 0.01, -0.02]), 0.05, 0.8
    biased = []
    for robot in (1, 2):
        run = read_run(folder, robot, world)
        b = run.bearing_rad
        far = run.range_m * (1.0 + np.column_stack([np.ones_like(b), b, b**2]) @ share)
        biased.append(
            replace(run, range_m=far, seen_s=run.seen_s + late_s, odometry=run.odometry / [1, factor, factor])
        )
    found = bias_of(biased, world)
    print(f"seed 9: {found}; expected {share}, {late_s} s, {factor}")
    assert found.range_share == pytest.approx(share, abs=0.006)
    assert found.latency_s == pytest.approx(late_s, abs=0.021)
    assert found.odometry == pytest.approx((factor, factor), rel=0.02)
    left = residuals([without(run, found) for run in biased], world)
    assert abs(float(np.mean(left[1]))) < 0.02
    assert without(biased[0], Bias()).range_m == pytest.approx(biased[0].range_m)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("Barcodes.dat", None, "Barcodes.dat: no such file"),
        ("Robot1_Odometry.dat", "1 2\n3 4\n", "found 2 rows of 2, expected 3 columns"),
        ("Robot1_Odometry.dat", "", "found 0 rows"),
        ("Robot1_Odometry.dat", "1 2 nan\n", "record 1 is not finite"),
        ("Robot1_Odometry.dat", "1 2 three\n", "cannot be read as a table"),
        ("Robot1_Odometry.dat", "1 0 0\n2 0 0\n", "do not overlap"),
        ("Robot1_Measurement.dat", "1010 99 1 0\n", "found no landmark"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_line(folder, tmp_path, name, content, says):
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / name).unlink()
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(FileFormatError, match=says) as caught:
        read_run(tmp_path, 1, read_world(tmp_path))
    assert "\n" not in str(caught.value)


def test_a_broken_gzip_and_an_unknown_robot(folder, tmp_path):
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "Robot2_Odometry.dat.gz").write_bytes(b"\x1f\x8b but not gzip")
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_run(tmp_path, 2, read_world(tmp_path))
    with pytest.raises(FileFormatError, match="no measurements of robot 7; there are those of 1, 2"):
        read_run(folder, 7, read_world(folder))
    with pytest.raises(FileFormatError, match="no such folder"):
        read_world(tmp_path / "nowhere")


def test_noise_is_turned_to_the_line_of_sight(folder):
    """The covariance that arrives in the map is R(bearing) diag(along, across) R', to rounding."""
    seen = []

    class Eye:
        def __init__(self):
            self.pose = np.array([0.0, 0.0, 0.3])

        def predict(self, motion):
            self.pose = compose(self.pose, motion.prev_from_curr)

        def update(self, obs):
            c, s = np.cos(self.pose[2]), np.sin(self.pose[2])
            r = np.array([[c, -s], [s, c]])
            seen.append((self.pose[:2] + r @ obs.xy_base_m[0], r @ np.diag(obs.var_m2[0]) @ r.T))

        def landmarks(self):
            return mrclam_run.known_map(LANDMARKS, np.arange(6, 11))

        def estimate(self):
            return self.pose, np.eye(3), None

    eye = Eye()
    noise = Noise((0.1, 0.0), (0.01, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0, 0.0))
    ranges, bearings = np.array([3.0, 3.0]), np.array([0.5, -1.2])
    event = mrclam_run.Event(0.0, np.zeros(3), 0.0, np.zeros(3), np.array([7, 6]), ranges, bearings, True)
    mrclam_run.step(eye, event, noise)
    assert np.allclose(eye.pose, [0.0, 0.0, 0.3])
    for (at, cov), r, b in zip(seen, ranges, 0.3 + bearings, strict=True):
        along = np.array([np.cos(b), np.sin(b)])
        assert np.allclose(at, r * along)
        assert along @ cov @ along == pytest.approx(0.1**2)
        assert np.linalg.det(cov) == pytest.approx((0.1 * 3.0 * 0.01) ** 2, rel=0.02)


def test_smoke(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(mrclam_noise, "SIGMA_FACTORS", (1.0,))
    monkeypatch.setattr(mrclam_noise, "ODOMETRY_FACTORS", (1.0, 2.0))
    out = tmp_path / "m.json"
    arguments = [str(folder), "--train", "1", "--test", "2", "--tasks", "localise", "--filters", "ukf_gated,pf"]
    assert mrclam.main([*arguments, "--particles", "50", "--seeds", "1", "--no-peers", "--json", str(out)]) == 0
    rows = {r["filter"]: r for r in json.loads(out.read_text())["localise"]}
    print(rows)
    assert rows["ukf_gated"]["rmse_m"] < 0.05
    assert rows["pf"]["rmse_m"] < 0.10
    assert "Known map" in capsys.readouterr().out


def test_wrong_arguments_are_one_line(folder, capsys):
    assert mrclam.main([str(folder), "--train", "1", "--test", "1"]) != 0
    assert "a robot is in both" in capsys.readouterr().err
    assert mrclam.main([str(folder), "--train", "one", "--test", "2"]) != 0
    assert "expected robots' numbers" in capsys.readouterr().err


def test_without_data_it_says_so(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("CEILVO_DATA", str(tmp_path))
    assert mrclam.main([]) == 0
    assert "skipped, no data set" in capsys.readouterr().out


def test_a_library_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "filterpy", None)
    assert "filterpy: skipped" in mrclam.peers.missing("filterpy")


def test_the_real_recordings_are_read():
    folder = mrclam.default_folder()
    if folder is None:
        pytest.skip("no recordings: set CEILVO_DATA")
    run = read_run(folder, 1, read_world(folder))
    assert len(run.seen_s) == 1534
    assert run.end_s - run.begin_s == pytest.approx(760, abs=2)
