"""Inputs that people bring to calib: wheels, marks that are found or clicked, points without a lens."""

from __future__ import annotations

import json
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.calib.session.session import Session
from ceilvo.calib.session.wheels import LiveWheels, live_base, recorded
from ceilvo.calib.solve.dlt import from_points_alone
from ceilvo.calib.targets.click_page import ClickPage
from ceilvo.calib.targets.marks import clicked, detected, read_marks
from ceilvo.calib.targets.sources import Picture
from ceilvo.calibration import Calibration
from ceilvo.calibration_file import read_calibration
from ceilvo.camera import CameraModel
from ceilvo.config import Base
from ceilvo.drivers.base.link import BaseLink
from ceilvo.drivers.base.wheel_track import WheelTrack
from ceilvo.drivers.telegrams import BaseStatus
from ceilvo.errors import CalibrationError
from ceilvo.sim.base import SimBase
from ceilvo.sim.rig import simulated_calibration

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Run = Callable[..., tuple[int, str, str]]

PLAIN = CameraModel("pinhole", 640, 480, 410.3, 409.1, 321.0, 238.0, (0.0,) * 5)
RIG = simulated_calibration(PLAIN, roll_rad=0.05, pitch_rad=-0.03, yaw_rad=0.4)


def picture(name: str, stamp_ns: int = 0, gray: Gray | None = None) -> Picture:
    return Picture(name, stamp_ns, np.zeros((480, 640), np.uint8) if gray is None else gray)


def project(rig: Calibration, xyz: Array) -> Array:
    """Independent of calib: eq. 5 as it stands."""
    s = np.column_stack([xyz, np.ones(len(xyz))]) @ rig.projection.T
    return np.asarray(s[:, :2] / s[:, 2:])


def save_lens(folder: Path, camera: CameraModel) -> None:
    lens = {"camera": asdict(camera), "camera_id": "", "model": "pinhole", "sigma": [0.1] * 9, "cov": np.zeros((9, 9))}
    Session(folder).save("intrinsics", lens | {"rms_px": 0.1, "verdict": "PASS"})


# -- wheels


def test_recorded_wheels_go_with_their_pictures(tmp_path: Path) -> None:
    (tmp_path / "wheels.csv").write_text("name,x_m,y_m,theta_rad\nb.png,1,2,0.5\na.png,0,0,0\n")
    wheels = recorded(tmp_path)
    np.testing.assert_array_equal(wheels(picture("b.png")), [1, 2, 0.5])
    assert wheels(picture("c.png")) is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("x_m,y_m,theta_rad\n1,2,0\n", "column 'name': found none"),
        ("name,x_m,y_m,theta_rad\na,1,2,0\na,1,2,0\n", "found a picture twice"),
        ("name,x_m,y_m,theta_rad\na,1,2,0\nb,1,2,20\n", "is it in degrees"),
        ("name,x_m,theta_rad\na,1,2\n", "column 'y_m' is missing"),
    ],
)
def test_recorded_wheels_that_are_wrong_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "wheels.csv").write_text(text)
    with pytest.raises(CalibrationError, match=reason):
        recorded(tmp_path)


def test_without_a_file_the_pictures_own_wheels_count(tmp_path: Path) -> None:
    own = Picture("a", 0, np.zeros((2, 2), np.uint8), wheels=np.ones(3))
    np.testing.assert_array_equal(recorded(tmp_path)(own), np.ones(3))


class Link:
    """A base link that has only its history."""

    def __init__(self) -> None:
        self.wheels = WheelTrack()

    def drive(self, first_ms: int, last_ms: int) -> None:
        """0.2 m/s straight ahead, a status every 50 ms; the clocks of base and host are one."""
        for ms in range(first_ms, last_ms + 1, 50):
            status = BaseStatus(True, False, False, False, round(2.0 * ms), 0, 0, ms)
            self.wheels.add(status, 1_000_000 * ms)


def test_live_wheels_add_up_to_the_way_of_the_base() -> None:
    link = Link()
    wheels = LiveWheels(cast(BaseLink, link))
    assert wheels(picture("before the first answer", 0)) is None
    link.drive(1000, 3000)
    for at_ms in (1500, 1730, 2000, 2990):
        pose = wheels(picture("", 1_000_000 * at_ms))
        assert pose is not None
        np.testing.assert_allclose(pose, [2e-4 * (at_ms - 1500), 0, 0], atol=3e-4)
    assert wheels(picture("ahead of the base", 1_000_000 * 3500)) is None
    link.drive(3050, 4000)
    np.testing.assert_allclose(wheels(picture("", 1_000_000 * 4000)), [0.5, 0, 0], atol=3e-4)


def test_a_live_base_is_asked_for_its_wheels() -> None:
    notes: list[str] = []
    with (
        SimBase(baud=115200) as sim,
        live_base(Base(port=sim.port, rate_hz=20.0, timeout_s=1.0), notes.append, patience_s=30.0) as link,
    ):
        assert link is not None and link.snapshot().telegrams_sent >= 1
    assert notes == [f"wheels from the base at {sim.port}"]


def test_a_base_that_does_not_answer_is_done_without(tmp_path: Path) -> None:
    notes: list[str] = []
    with live_base(Base(port=str(tmp_path / "no-such-port")), notes.append, patience_s=0.3) as link:
        assert link is None
    assert len(notes) == 1 and "without wheels" in notes[0] and "no-such-port" in notes[0]


# -- marks

MARKS = np.array([[0.5, 0.3, 0], [-0.5, 0.4, 0], [-0.4, -0.4, 0], [0.6, -0.35, 0], [0.05, 0.1, 0.0]])
SIDE_M = 0.16


def ceiling_with_markers() -> Gray:
    """Each marker is projected by itself, corner by corner."""
    words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    image = np.full((480, 640), 200, np.uint8)
    for i, at in enumerate(MARKS):
        face = np.pad(cv2.aruco.generateImageMarker(words, i, 70), 10, constant_values=255)
        half = 0.5 * SIDE_M * 90 / 70
        corners = at + half * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
        uv = project(RIG, corners).astype(np.float32)
        edge = np.array([[-0.5, -0.5], [89.5, -0.5], [89.5, 89.5], [-0.5, 89.5]], np.float32)
        h = cv2.getPerspectiveTransform(edge, uv)
        drawn = cv2.warpPerspective(face, h, (640, 480), flags=cv2.INTER_AREA)
        mask = cv2.warpPerspective(np.full_like(face, 255), h, (640, 480))
        image = np.where(mask > 128, drawn, image)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.6), np.uint8)


def marks_file(path: Path, with_id: bool = True) -> Path:
    head = "id,x_m,y_m\n" if with_id else "x_m,y_m\n"
    path.write_text(head + "".join((f"{i}," if with_id else "") + f"{x},{y}\n" for i, (x, y, _) in enumerate(MARKS)))
    return path


def test_markers_on_the_ceiling_give_the_whole_mounting(run: Run, tmp_path: Path) -> None:
    save_lens(tmp_path / "s", PLAIN)
    (tmp_path / "i").mkdir()
    for k in range(2):
        cv2.imwrite(str(tmp_path / "i" / f"{k}.png"), ceiling_with_markers())
    marks = str(marks_file(tmp_path / "m.csv"))
    code, out, err = run("projection", "--marks", marks, "--images", str(tmp_path / "i"))
    assert code == 0, out + err
    assert "5 marks found in 2 pictures" in out
    found = read_calibration(tmp_path / "s" / "calibration.yaml")
    assert abs(found.ceiling_height_m - 2.2) < 0.02
    assert np.abs(found.mount_xy_m - RIG.mount_xy_m).max() < 0.02
    assert np.abs(found.camera_from_base - RIG.camera_from_base).max() < 0.01
    assert (tmp_path / "s" / "projection" / "points.csv").read_text().startswith("x_m,y_m,z_m,u_px,v_px\n")


def test_missing_and_moving_markers_are_refused(tmp_path: Path) -> None:
    marks = read_marks(marks_file(tmp_path / "m.csv"), None, lambda _: False)
    gray = ceiling_with_markers()
    with pytest.raises(CalibrationError, match=r"found 0 of 5 markers in 1 pictures"):
        detected(marks, [picture("a", gray=np.full((480, 640), 90, np.uint8))], "5X5_100", 4)
    with pytest.raises(CalibrationError, match="let it stand"):
        detected(marks, [picture("a", gray=gray), picture("b", gray=np.roll(gray, 4, axis=1))], "5X5_100", 4)
    with pytest.raises(CalibrationError, match="--dictionary: found '9X9'"):
        detected(marks, [], "9X9", 4)


def test_clicks_come_back_from_the_page(capfd: pytest.CaptureFixture[str]) -> None:
    """What a browser would do: load the page, send something wrong, then the clicks."""
    clicks, gray = [[10.25, 20.5], [300.0, 11.0]], np.full((48, 64), 100, np.uint8)
    got: list[Array] = []
    thread = threading.Thread(target=lambda: got.append(ClickPage()(gray, ["mark 1", "<mark 2>"])), daemon=True)
    thread.start()
    said, until = "", time.monotonic() + 20.0
    while "open http" not in said and time.monotonic() < until:
        said += capfd.readouterr().err
        thread.join(0.02)
    url = said.split("open ")[1].split()[0]
    page = urllib.request.urlopen(url, timeout=10).read().decode()
    assert "data:image/png;base64," in page and "<mark 2>" not in page
    with pytest.raises(urllib.error.HTTPError, match="400"):
        urllib.request.urlopen(urllib.request.Request(url, data=b"[[1, 2]]"), timeout=10)
    urllib.request.urlopen(urllib.request.Request(url, data=json.dumps(clicks).encode()), timeout=10)
    thread.join(20.0)
    np.testing.assert_array_equal(got[0], clicks)


def test_clicked_marks_are_those_of_the_list(tmp_path: Path) -> None:
    marks = read_marks(marks_file(tmp_path / "m.csv", with_id=False), None, lambda _: False)
    uv = project(RIG, MARKS)
    xyz, got, count = clicked(marks, [picture("a"), picture("b")], lambda gray, names: uv)
    np.testing.assert_array_equal(xyz, MARKS)
    np.testing.assert_array_equal(got, uv)
    assert count == 2 and marks.names[0] == "mark 1 at 0.5, 0.3 m"
    with pytest.raises(CalibrationError, match="found 0 usable pictures"):
        clicked(marks, [], lambda gray, names: uv)


@pytest.mark.parametrize("listen", ["8080", "localhost:x", "127.0.0.1:70000"])
def test_a_wrong_address_of_the_page_is_named(listen: str) -> None:
    with pytest.raises(CalibrationError, match="expected HOST:PORT"):
        ClickPage(listen)


# -- points without a lens


def points(seed: int, n: int = 14) -> Array:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.6, 0.6, (n, 2)), rng.uniform(-0.6, 0.0, n)])


@pytest.mark.parametrize("seed", range(4))
def test_lens_and_mounting_from_points_alone_are_exact_without_noise(seed: int) -> None:
    xyz = points(seed)
    found, camera, _ = from_points_alone(xyz, project(RIG, xyz), (640, 480))
    assert found.yaw_rad is not None and found.xy_m is not None
    got = [found.roll_rad, found.pitch_rad, found.height_m, found.yaw_rad, *found.xy_m]
    np.testing.assert_allclose(got, [0.05, -0.03, 2.2, 0.4, 0.05, -0.03], rtol=0, atol=1e-9)
    np.testing.assert_allclose([camera.fx_px, camera.cy_px], [410.3, 238.0], rtol=0, atol=1e-7)


def test_their_sigma_is_that_of_the_scatter() -> None:
    """60 draws of 0.3 px noise on the same points."""
    xyz = points(3)
    z = []
    for seed in range(60):
        uv = project(RIG, xyz) + np.random.default_rng([seed, 9]).normal(0, 0.3, (len(xyz), 2))
        found, camera, cov = from_points_alone(xyz, uv, (640, 480))
        z.append([(found.height_m - 2.2) / found.sigma[2], (camera.fx_px - 410.3) / np.sqrt(cov[0, 0])])
    spread = np.sqrt(np.mean(np.square(z), axis=0))
    assert (spread > 0.75).all() and (spread < 1.3).all(), spread


def points_file(path: Path, xyz: Array) -> Path:
    rows = "".join(",".join(f"{v:.5f}" for v in row) + "\n" for row in np.column_stack([xyz, project(RIG, xyz)]))
    path.write_text("x_m,y_m,z_m,u_px,v_px\n" + rows)
    return path


def test_a_session_may_begin_with_points_alone(run: Run, tmp_path: Path) -> None:
    file = str(points_file(tmp_path / "p.csv", points(1)))
    code, out, err = run("projection", "--points", file, "--size", "640x480")
    assert code == 0 and "lens unknown: DLT" in out, out + err
    found = read_calibration(tmp_path / "s" / "calibration.yaml")
    np.testing.assert_allclose(found.projection, RIG.projection, rtol=1e-3, atol=0.05)
    code, _, err = run("projection", "--points", file, "--size", "640x480", "--force")
    assert code == 0, err
    (tmp_path / "s" / "projection.json").unlink()
    code, _, err = run("projection", "--points", file, "--size", "640x480")
    assert code == 78 and "found a lens in" in err


@pytest.mark.parametrize(
    ("size", "xyz", "reason"),
    [
        ("640", points(1), "expected WIDTHxHEIGHT"),
        ("640x480", points(1) * [1, 1, 0], "in one plane, which needs a known lens"),
        ("640x480", points(1, 5), "5 points, at least 6 needed without"),
    ],
)
def test_points_alone_that_cannot_work_are_refused(
    run: Run, tmp_path: Path, size: str, xyz: Array, reason: str
) -> None:
    code, _, err = run("projection", "--points", str(points_file(tmp_path / "p.csv", xyz)), "--size", size)
    assert code == 78 and reason in err
