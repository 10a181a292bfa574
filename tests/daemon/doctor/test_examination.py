"""`ceilvod doctor` with real parts: where all is well, and what it says and returns of what is wrong."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import pytest

from ceilvo.calibration_file import write_calibration
from ceilvo.config import Base, Camera, Config, Service, Zenoh
from ceilvo.config.rendering import render_config
from ceilvo.daemon import cli
from ceilvo.drivers.camera.recorded import write_folder
from ceilvo.sim.base import SimBase
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.types import Frame


@pytest.fixture
def whole(tmp_path: Path, simulated: SimBase) -> Path:
    """A configuration whose camera is a folder of pictures and whose base is a process on a pseudo-terminal."""
    model = simulated_camera("pinhole", 96, 72)
    found = replace(simulated_calibration(model), created=datetime.now(timezone.utc).date().isoformat())
    write_calibration(tmp_path / "calibration.yaml", found)
    write_folder(tmp_path / "frames", [Frame(i, i + 1, np.zeros((72, 96), np.uint8)) for i in range(2)])
    (tmp_path / "state").mkdir()
    config = Config(
        camera=Camera(source="folder", path=str(tmp_path / "frames"), width_px=96, height_px=72),
        base=Base(port=simulated.port),
        zenoh=Zenoh(multicast=False),
        service=Service(state_dir=str(tmp_path / "state")),
    )
    (tmp_path / "config.yaml").write_text(render_config(config))
    return tmp_path / "config.yaml"


def test_all_is_well(whole: Path, simulated: SimBase, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--config", str(whole)]) == 0
    lines = capsys.readouterr().out.splitlines()
    found = {line[6:18].strip(): line[:5].strip() for line in lines}
    assert all(found[c] == "OK" for c in ("config", "camera", "calibration", "base", "zenoh", "limits")), lines
    assert any("answers in protocol version 1" in line for line in lines)
    assert len(simulated.telegrams) == 0, "a doctor must not tell the base a pose"


def test_what_is_wrong_is_told_with_exit_code_1(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--config", str(whole), "--set", "base.port=/dev/ttyNO", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    (bad,) = (f for f in told["findings"] if f["level"] == "wrong")
    assert told["ok"] is False and bad["check"] == "base"
    assert "/dev/ttyNO: no such device" in bad["text"]


def test_a_wrong_configuration_does_not_hide_the_rest(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole.write_text("camera:\n  width_px: many\n  colour: true\n")
    assert cli.main(["doctor", "--config", str(whole)]) == 1
    out = capsys.readouterr().out
    assert out.count("WRONG config") == 2 and "limits" in out
