"""The doctor on cameras and calibrations, with each thing wrong that it looks for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from fake_machine import GOOD_OFFER, fake, levels, patient, wrongs

from ceilvo.calibration_file import write_calibration
from ceilvo.config import Camera, Config
from ceilvo.daemon.doctor.camera import calibration, camera
from ceilvo.daemon.doctor.findings import Patient
from ceilvo.drivers.camera.v4l2_device import LinuxDevice
from ceilvo.drivers.camera.v4l2_query import Control, Offer, Size
from ceilvo.sim.rig import simulated_calibration, simulated_camera

# -- camera


def test_a_good_camera(tmp_path: Path, node: str) -> None:
    assert levels(camera(patient(tmp_path, node))) == ["fine", "fine", "fine"]


def offer(**changes: object) -> Offer:
    return replace(GOOD_OFFER, **changes)  # type: ignore[arg-type]


BAD_CAMERAS: dict[str, tuple[dict[str, object], str]] = {
    "no permission": ({"writable": False}, "usermod -aG video"),
    "no video device": ({"offer": None}, "does not answer as a video device"),
    "metadata node": ({"offer": offer(captures=False)}, "gives no pictures"),
    "in use": ({"held": ("cheese (pid 9)",)}, "in use by cheese (pid 9): only one can have it"),
    "in use, our daemon too": ({"held": ("cheese (pid 9)", "ceilvod (pid 77)"), "running": "77"}, "in use by cheese"),
    "format": ({"offer": offer(sizes={"MJPG": ()})}, "YUYV is not offered, found MJPG; set it to MJPG"),
    "size": (
        {"offer": offer(sizes={"YUYV": (Size((320, 240), (320, 240)),)})},
        "not offered at 640x480, found 320x240",
    ),
    "step": ({"offer": offer(sizes={"YUYV": (Size((2, 1), (999, 999), (7, 1)),)})}, "found 2x1 to 999x999"),
    "rate": ({"offer": offer(max_rate_hz=15.0)}, "camera.rate_hz: 30 is more than the 15"),
    "no exposure": ({"offer": offer(controls={"gain": Control(0, 100, True)})}, "no exposure that can be set"),
    "read-only": ({"offer": offer(controls={**GOOD_OFFER.controls, "gain": Control(0, 9, False)})}, "no gain that can"),
    "exposure": ({"offer": offer(controls={**GOOD_OFFER.controls, "exposure": Control(1, 50, True)})}, "100 to 5000"),
    "gain": ({"offer": offer(controls={**GOOD_OFFER.controls, "gain": Control(0, 9, True)})}, "range, 0 to 9"),
}


@pytest.mark.parametrize("name", BAD_CAMERAS)
def test_what_can_be_wrong_with_a_camera(tmp_path: Path, node: str, name: str) -> None:
    changes, expected = BAD_CAMERAS[name]
    (text,) = wrongs(camera(patient(tmp_path, node, **changes)))  # type: ignore[arg-type]
    assert expected in text


def test_a_camera_that_is_not_there(tmp_path: Path, node: str) -> None:
    Path(node).unlink()
    (text,) = wrongs(camera(patient(tmp_path, node)))
    assert "no such device" in text and "no camera at all" in text


def test_the_daemons_own_hold_is_fine(tmp_path: Path, node: str) -> None:
    found = list(camera(patient(tmp_path, node, running="77", held=("ceilvod (pid 77)",))))
    assert not wrongs(found) and "in use by ceilvod (pid 77)" in found[0].text


def test_automatic_exposure_is_worth_a_note(tmp_path: Path, node: str) -> None:
    p = patient(tmp_path, node)
    assert p.config is not None
    p = replace(p, config=replace(p.config, camera=replace(p.config.camera, exposure_us=None, gain=None)))
    assert levels(camera(p)) == ["fine", "fine", "note"]


def test_a_recording_that_is_not_there(tmp_path: Path) -> None:
    config = Config(camera=Camera(source="folder", path=str(tmp_path / "absent")))
    (text,) = wrongs(camera(Patient(config, tmp_path / "config.yaml", None, machine=fake(tmp_path))))
    assert "no such folder" in text


# -- calibration


def calibrated(p: Patient, camera_id: str = "", created: str = "2100-11-01", width_px: int = 640) -> Patient:
    model = simulated_camera("pinhole", width_px, 480)
    found = replace(simulated_calibration(model), camera_id=camera_id, created=created)
    write_calibration(p.config_path.parent / "calibration.yaml", found, force=True)
    return p


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"camera_id": "another serial"}, "camera id 'usb-a-camera', expected 'another serial'"),
        ({"width_px": 800}, "640 x 480 pixels, expected 800 x 480"),
    ],
)
def test_a_calibration_that_does_not_fit(
    tmp_path: Path, node: str, changes: dict[str, object], expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LinuxDevice, "identity", lambda self, node: "usb-a-camera")
    (text,) = wrongs(calibration(calibrated(patient(tmp_path, node), **changes)))  # type: ignore[arg-type]
    assert expected in text


def test_a_calibration_that_is_absent_damaged_or_old(tmp_path: Path, node: str) -> None:
    p = patient(tmp_path, node)
    assert "no such file" in wrongs(calibration(p))[0]
    calibrated(p)
    file = p.config_path.parent / "calibration.yaml"
    file.write_text(file.read_text().replace("2100-11-01", "2100-11-02"))
    assert "checksum" in wrongs(calibration(p))[0]
    old, _ = calibration(calibrated(p, created="2001-01-01"))
    assert old.level == "note" and "days old; 'calib check'" in old.text
    assert levels(calibration(calibrated(p, created=""))) == ["fine", "note"]


@pytest.mark.parametrize(
    ("scale", "level", "text"),
    [
        ({}, "note", "scale unconfirmed: nothing but its tile of 0.6 m"),
        ({"state": "unconfirmed", "sources": []}, "note", "scale unconfirmed"),
        ({"state": "confirmed", "sources": ["wheels: +0.1 %"]}, "fine", "scale confirmed: wheels: +0.1 %"),
        ({"state": "contradicted", "sources": ["wheels: +4 %"]}, "wrong", "scale contradicted: wheels: +4 %"),
    ],
)
def test_whether_a_second_source_confirmed_the_scale(
    tmp_path: Path, node: str, scale: dict[str, object], level: str, text: str
) -> None:
    p = patient(tmp_path, node)
    found = replace(simulated_calibration(), camera_id="", meta={"scale": scale} if scale else {})
    write_calibration(p.config_path.parent / "calibration.yaml", found)
    _, finding = calibration(p)
    assert (finding.check, finding.level) == ("scale", level) and text in finding.text
