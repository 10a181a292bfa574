"""The ceilvod command as people type it."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE_S

from ceilvo.calibration_file import write_calibration
from ceilvo.config import Config
from ceilvo.config.rendering import render_config
from ceilvo.daemon.cli import main
from ceilvo.daemon.replay.trajectory import compare
from ceilvo.sim.record import main as record

Capture = pytest.CaptureFixture[str]
SUMMARY_KEYS = {
    *("state", "frames", "fps", "drops", "position_rms_m", "position_max_m", "heading_rms_deg", "latency_ms"),
    *("telegrams_sent", "telegrams_failed", "zenoh_samples"),
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recording")
    assert record([str(folder), "--seconds", "3", "--fps", "10", "--seed", "4"]) in (0, None)
    return folder


def test_help_of_every_command_has_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    for command in ([], ["run"], ["replay"], ["watch"], ["check-config"]):
        with pytest.raises(SystemExit) as end:
            main([*command, "--help"])
        assert end.value.code == 0
        assert "example: ceilvod" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["mrclam", "DIR", "--test", "3"], "experiment is now python -m ceilvo.bench.mrclam\n"),
        (["speed"], "experiment is now python -m ceilvo.bench.speed.filter_step\n"),
        ([], "experiment is now python -m ceilvo.bench.paper, python -m ceilvo.bench.mrclam, python -m "),
    ],
)
def test_experiment_says_where_it_has_gone(words: list[str], named: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["experiment", *words]) == 2
    assert capsys.readouterr().err.startswith(f"ceilvod: {named}")


def test_replay_is_repeatable_and_near_the_truth(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    start = np.loadtxt(recording / "truth.tum")[0]
    arguments = ["replay", str(recording), "--reference", str(recording / "truth.tum")]
    arguments += ["--set", f"filter.initial_pose_x_m={start[1]}", "--set", f"filter.initial_pose_y_m={start[2]}"]
    for name in ("a", "b"):
        out = [*arguments, "--tum", str(tmp_path / f"{name}.tum"), "--jsonl", str(tmp_path / f"{name}.jsonl")]
        assert main([*out, "--pictures", str(tmp_path / name)]) == 0
    assert (tmp_path / "a.tum").read_bytes() == (tmp_path / "b.tum").read_bytes()
    assert (tmp_path / "a.jsonl").read_bytes() == (tmp_path / "b.jsonl").read_bytes()
    assert len(list((tmp_path / "a").glob("*.png"))) == 3
    distance = compare(tmp_path / "a.tum", recording / "truth.tum")
    print(f"rms {distance.position_rms_m * 1e3:.2f} mm")
    assert distance.position_rms_m < 0.005
    assert "29 good, 1 predicted" in capsys.readouterr().out


def test_replay_of_something_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path / "nowhere")]) != 0
    assert "nowhere" in capsys.readouterr().err


def test_replay_with_another_size_of_calibration(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from ceilvo.sim.rig import simulated_calibration, simulated_camera

    other = tmp_path / "other.yaml"
    write_calibration(other, simulated_calibration(simulated_camera(width_px=320, height_px=240)))
    assert main(["replay", str(recording), "--calibration", str(other)]) != 0
    assert "320 x 240" in capsys.readouterr().err


def test_check_config(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = tmp_path / "config.yaml"
    good.write_text(render_config(Config()))
    assert main(["check-config", str(good)]) == 0
    bad = tmp_path / "bad.yaml"
    bad.write_text("filter:\n  partikles: 100\n")
    assert main(["check-config", str(bad)]) == 78
    message = capsys.readouterr().err
    assert "bad.yaml:2" in message and "particles" in message


def test_run_without_a_configuration_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--config", str(tmp_path / "none.yaml")]) == 78
    assert "none.yaml" in capsys.readouterr().err


def spawn(arguments: list[str], folder: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "ceilvo.daemon.cli", *arguments]
    return subprocess.Popen(command, cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)


def test_simulated_run_ends_by_itself_with_a_summary(tmp_path: Path) -> None:
    process = spawn(["run", "--simulate", "--seconds", "4", "--set", "zenoh.multicast=false"], tmp_path)
    output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0, output
    summary = json.loads((tmp_path / "build" / "run-summary.json").read_text())
    assert set(summary) >= SUMMARY_KEYS
    assert summary["state"] == "TRACKING", output
    assert summary["position_rms_m"] < 0.01
    assert summary["telegrams_sent"] > 20 and summary["zenoh_samples"] > 50
    for stage in ("edges", "lines", "crossings", "odometry", "filter", "step"):
        assert set(summary["latency_ms"][stage]) == {"median", "p99"}


def test_sigterm_is_an_orderly_end(tmp_path: Path) -> None:
    process = spawn(["run", "--simulate", "--set", "zenoh.multicast=false"], tmp_path)
    assert process.stdout is not None
    os.set_blocking(process.stdout.fileno(), True)
    for line in process.stdout:
        if "TRACKING" in line:
            break
    asked = time.monotonic()
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    print(f"ended {time.monotonic() - asked:.2f} s after SIGTERM")


@pytest.mark.parametrize(
    "option",
    [("--seed", "-1"), ("--seed", "7" * 5000), ("--tilt-deg", "nan"), ("--tilt-deg", "1e300"), ("--seconds", "inf")],
    ids=lambda option: f"{option[0]} {option[1][:5]}",
)
def test_a_number_that_cannot_be_is_wrong_use(option: tuple[str, str], capsys: Capture) -> None:
    with pytest.raises(SystemExit) as end:
        main(["run", "--simulate", *option])
    assert end.value.code == 2
    assert f"argument {option[0]}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("rnu", "no command 'rnu'; did you mean 'run'?"),
        ("docter", "no command 'docter'; did you mean 'doctor'?"),
        ("wathc", "no command 'wathc'; did you mean 'watch'?"),
        ("xyzzy", "no command 'xyzzy'; expected run, record, replay"),
    ],
)
def test_a_mistyped_command_is_answered_with_the_right_one(word: str, said: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as end:
        main([word, "--config", "x"])
    assert end.value.code == 2 and said in capsys.readouterr().err


def test_run_without_a_configuration_suggests_the_simulation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.setattr("ceilvo.daemon.cli.DEFAULT_CONFIG", tmp_path / "config.yaml")
    assert main(["run"]) == 78
    said = capsys.readouterr().err
    assert "config.yaml: no such file" in said and "ceilvod run --simulate" in said
    assert main(["run", "--config", str(tmp_path / "mine.yaml")]) == 78
    assert "--simulate" not in capsys.readouterr().err


def test_replay_of_what_is_no_recording_does_not_ask_for_a_calibration(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "README.md").write_text("# ceilvo\n")
    (tmp_path / "empty").mkdir()
    for name in ("README.md", "empty"):
        assert main(["replay", str(tmp_path / name)]) != 0
        said = capsys.readouterr().err
        assert name in said and "an MCAP file, a folder of pictures or a video" in said and "calibration" not in said
