"""`calib shutter`: the readout of a simulated pan, its direction, and pans that say nothing."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from ceilvo.calib.evaluate.shutter import measure
from ceilvo.calib.practice.virtual_bench import PAN_READOUT_S, VirtualBench
from ceilvo.calib.session.session import Session
from ceilvo.calibration_file import read_calibration
from ceilvo.errors import CalibrationError
from ceilvo.types import Frame

FRAMES = 40
MOST_S = 0.0008
"""That a short pan of a small picture may be off; SIGMA_S of a PASS is more."""


def pan(bench: VirtualBench, readout_s: float) -> list[Frame]:
    return [Frame(i, p.stamp_ns, p.gray) for i, p in enumerate(bench.pan(FRAMES, readout_s))]


def test_a_pan_tells_time_and_direction(bench: VirtualBench) -> None:
    found = measure(bench.rig, pan(bench, -0.012))
    print(found)
    assert abs(found.readout_s + 0.012) < min(3.0 * found.sigma_s, MOST_S)
    assert found.rolls
    assert "the last one first" in found.text


def test_a_global_shutter_is_none(bench: VirtualBench) -> None:
    found = measure(bench.rig, pan(bench, 0.0))
    print(found)
    assert abs(found.readout_s) < MOST_S
    assert not found.rolls
    assert found.text.startswith("global")


def test_a_robot_that_stands_is_told_to_turn(bench: VirtualBench) -> None:
    still = next(iter(bench.pan(1, 0.02))).gray
    frames = [Frame(i, 10**9 + i * 33_333_333, still) for i in range(16)]
    with pytest.raises(CalibrationError, match=r"focal lengths a second, at least 0.15 needed; turn the robot"):
        measure(bench.rig, frames)


def test_too_few_frames_are_refused(bench: VirtualBench) -> None:
    with pytest.raises(CalibrationError, match="12 needed"):
        measure(bench.rig, pan(bench, 0.02)[:6])


def test_the_command_writes_it_into_the_calibration(
    known_lens: Session,
    projected: Path,
    bench: VirtualBench,
    run: Callable[..., tuple[int, str, str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shutil.copytree(projected, known_lens.folder, dirs_exist_ok=True)
    pictures = list(bench.pan(FRAMES))
    monkeypatch.setattr(VirtualBench, "pan", lambda *_: iter(pictures))
    code, out, err = run("shutter", "--simulate")
    print(out, err)
    assert code == 0, out + err
    assert "rolling" in out
    assert "the first one first" in out
    result = json.loads((known_lens.folder / "shutter.json").read_text())
    assert abs(result["readout_s"] - PAN_READOUT_S) < min(3.0 * result["sigma_s"], MOST_S)
    assert read_calibration(known_lens.folder / "calibration.yaml").camera.readout_s == result["readout_s"]
    assert run("shutter", "--simulate")[0] == 78, "a result is not replaced unasked"
