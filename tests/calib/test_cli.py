"""The command calib."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceilvo.calib.cli import main
from ceilvo.calibration import mount_angles
from ceilvo.calibration_file import read_calibration
from ceilvo.sim.rig import simulated_calibration


def test_simulate_then_show_prints_the_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "k.yaml"
    assert main(["simulate", str(file)]) == 0
    np.testing.assert_array_equal(read_calibration(file).projection, simulated_calibration().projection)
    capsys.readouterr()
    assert main(["show", str(file)]) == 0
    shown = capsys.readouterr().out
    for part in (
        "ceilvo-sim, pinhole, 640 x 480 px",
        "2.200 m above the camera",
        "+0.050 m forward, -0.030 m left",
        "yaw +2.00, roll +0.00, pitch +0.00 deg",
        "5.36 mm on the ceiling",
    ):
        assert part in shown


def test_a_file_is_not_replaced_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "k.yaml"
    assert main(["simulate", str(file)]) == 0
    assert main(["simulate", str(file), "--lens", "fisheye"]) == 78
    assert "pass --force to replace it" in capsys.readouterr().err
    assert main(["simulate", str(file), "--lens", "fisheye", "--force"]) == 0
    assert read_calibration(file).camera.kind == "fisheye"
    assert read_calibration(tmp_path / "k.yaml.bak").camera.kind == "pinhole"


def test_an_edited_file_is_refused_until_signed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "k.yaml"
    assert main(["simulate", str(file)]) == 0
    file.write_text(file.read_text().replace("tile_m: 0.6", "tile_m: 0.5"))
    assert main(["show", str(file)]) == 78
    assert f"accept it with 'calib sign {file}'" in capsys.readouterr().err
    assert main(["sign", str(file)]) == 0
    assert main(["show", str(file)]) == 0
    assert "0.5 m" in capsys.readouterr().out


def test_a_missing_file_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["show", str(tmp_path / "none.yaml")]) == 78
    assert capsys.readouterr().err == f"{tmp_path}/none.yaml: found no such file, expected a readable file\n"


tilt = st.floats(-0.5, 0.5)


@given(st.floats(-3.1, 3.1), tilt, tilt)
def test_the_angles_shown_are_those_of_the_mounting(yaw: float, roll: float, pitch: float) -> None:
    calibration = simulated_calibration(yaw_rad=yaw, roll_rad=roll, pitch_rad=pitch)
    np.testing.assert_allclose(mount_angles(calibration.camera_from_base), [yaw, roll, pitch], atol=1e-9)


@pytest.mark.parametrize(("option", "value"), [("--seed", "-1"), ("--window-px", "0"), ("--seed", "x")])
def test_a_number_that_cannot_be_is_wrong_use(option: str, value: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["intrinsics", "--simulate", option, value])
    assert end.value.code == 2
    assert f"argument {option}" in capsys.readouterr().err
