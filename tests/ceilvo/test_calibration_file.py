"""Calibration files: what comes back, what is refused and how it is said."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from ceilvo import calibration_file
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.calibration_file import check_fits, read_calibration, sign_calibration, write_calibration
from ceilvo.camera import CameraModel
from ceilvo.errors import EXIT_CONFIG, CalibrationError
from ceilvo.yaml_nodes import MAX_BYTES

LENS = CameraModel("pinhole", 640, 480, 410.3, 409.1, 322.7, 236.4, (-0.15, 0.03, 6e-4, -4e-4, -0.002))


def calibration(**changes: Any) -> Calibration:
    m = projection_matrix(LENS, mount_rotation(0.03, 0.01, -0.02), (0.05, -0.03), 2.2)
    noise = NoiseCurves((0.003, 0.0, 0.002), (0.004, 1e-5), 0.002, 0.0, 2.5)
    start = Calibration(LENS, m, noise, "usb-0001", "2026-01-31", 0.6, {"residual_px": 0.21})
    return dataclasses.replace(start, **changes)


def same(a: Calibration, b: Calibration) -> bool:
    rest = all(getattr(a, f.name) == getattr(b, f.name) for f in dataclasses.fields(a) if f.name != "projection")
    return rest and np.array_equal(a.projection, b.projection)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "calibration.yaml"
    write_calibration(file, calibration())
    return file


def test_what_is_written_is_read_back_exactly(path: Path) -> None:
    assert same(read_calibration(path), calibration())


@given(
    f=st.floats(10.0, 1e5),
    height=st.floats(0.3001, 29.99),
    k=st.lists(st.floats(-10, 10), min_size=5, max_size=5),
    camera_id=st.text(st.characters(exclude_categories=["C", "Z"]), max_size=40),
    tile=st.none() | st.floats(0.05, 10.0),
    meta=st.dictionaries(
        st.text(max_size=8),
        st.recursive(
            st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
            lambda inner: st.lists(inner, max_size=3),
            max_leaves=5,
        ),
        max_size=4,
    ),
)
def test_every_float_and_text_survives(
    tmp_path_factory: pytest.TempPathFactory,
    f: float,
    height: float,
    k: list[float],
    camera_id: str,
    tile: float | None,
    meta: dict[str, Any],
) -> None:
    lens = CameraModel("pinhole", 640, 480, f, f, 322.7, 236.4, tuple(k))
    m = projection_matrix(lens, mount_rotation(0.5), (0.1, 0.2), height)
    before = calibration(camera=lens, projection=m, camera_id=camera_id, tile_m=tile, meta=meta)
    file = tmp_path_factory.mktemp("k") / "k.yaml"
    write_calibration(file, before)
    assert same(read_calibration(file), before)


def test_meta_takes_numpy_and_refuses_what_a_file_cannot_hold(tmp_path: Path) -> None:
    file = tmp_path / "k.yaml"
    write_calibration(file, calibration(meta={"sigma": {"fx_px": np.float64(0.5), "cov": np.eye(2)}, "n": np.int64(3)}))
    assert read_calibration(file).meta == {"sigma": {"fx_px": 0.5, "cov": [[1.0, 0.0], [0.0, 1.0]]}, "n": 3}
    for bad in (float("nan"), object(), {1: 2}):
        with pytest.raises(CalibrationError, match=r"meta\.x: found"):
            write_calibration(tmp_path / "bad.yaml", calibration(meta={"x": bad}))
    assert not (tmp_path / "bad.yaml").exists()


def test_a_file_is_only_replaced_when_told_and_kept(path: Path) -> None:
    old = path.read_bytes()
    with pytest.raises(CalibrationError, match="found a file there, expected none; pass --force"):
        write_calibration(path, calibration(tile_m=0.5))
    assert path.read_bytes() == old
    write_calibration(path, calibration(tile_m=0.5), force=True)
    assert read_calibration(path).tile_m == 0.5
    assert path.with_name("calibration.yaml.bak").read_bytes() == old
    assert sorted(p.name for p in path.parent.iterdir()) == ["calibration.yaml", "calibration.yaml.bak"]


def test_a_folder_that_is_not_there_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"k\.yaml: cannot be written \(No such file"):
        write_calibration(tmp_path / "missing" / "k.yaml", calibration())


def test_a_failed_write_leaves_the_old_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = path.read_bytes()

    def no_rename(self: Path, target: Path) -> Path:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", no_rename)
    with pytest.raises(CalibrationError, match="cannot be written"):
        write_calibration(path, calibration(tile_m=0.5), force=True)
    assert path.read_bytes() == old
    assert [p.name for p in path.parent.iterdir()] == ["calibration.yaml"]


def test_other_readers_see_the_same_values(path: Path) -> None:
    """A YAML 1.1 reader agrees with ours, so that other tools can use the file."""
    content = yaml.safe_load(path.read_text())
    assert content["created"] == "2026-01-31"
    assert content["camera"]["distortion"] == list(LENS.distortion)
    assert np.array_equal(content["projection"], calibration().projection)
    assert content["noise"]["sigma_y_m"] == [0.004, 1e-5]


def test_any_changed_digit_is_noticed(path: Path) -> None:
    text = path.read_text()
    body = text[: text.index("\nchecksum")]
    digits = [m.start() for m in re.finditer(r"\d", body) if body[: m.start()].count("\n") >= 2]
    assert len(digits) > 100
    for at in digits[::7]:
        changed = str((int(text[at]) + 1) % 10)
        other = text[:at] + changed + text[at + 1 :]
        assert yaml.safe_load(other) != yaml.safe_load(text)
        path.write_text(other)
        with pytest.raises(CalibrationError):
            read_calibration(path)


def test_an_edit_is_named_and_can_be_signed(path: Path) -> None:
    edited = path.read_text().replace("tile_m: 0.6", "tile_m: 0.5")
    path.write_text(edited)
    with pytest.raises(CalibrationError) as e:
        read_calibration(path)
    assert re.search(
        r"checksum: found 'sha256:\w+', expected 'sha256:\w+'; the file was edited or damaged", str(e.value)
    )
    assert f"calib sign {path}" in str(e.value)
    assert e.value.exit_code == EXIT_CONFIG == 78
    sign_calibration(path)
    assert read_calibration(path).tile_m == 0.5
    assert path.with_name("calibration.yaml.bak").read_text() == edited


def test_comments_and_layout_are_not_an_edit(path: Path) -> None:
    path.write_text(
        "# looked at by me\n" + path.read_text().replace("\n", "\r\n").replace("tile_m: 0.6", "tile_m:   0.60")
    )
    assert same(read_calibration(path), calibration())


def test_signing_does_not_accept_impossible_values(path: Path) -> None:
    path.write_text(path.read_text().replace("tile_m: 0.6", "tile_m: 60"))
    with pytest.raises(CalibrationError, match=r"tile_m: found 60, expected 0\.05 to 10"):
        sign_calibration(path)


def edit(path: Path, old: str, new: str) -> None:
    """Change the text and sign it as a careful forger would."""
    text = path.read_text()
    assert old in text
    content = yaml.safe_load(text.replace(old, new, 1))
    content["checksum"] = calibration_file._checksum(content)
    path.write_text(yaml.safe_dump(content))


WRONG = [
    ("version: 1", "version: 2", r"version: found 2, expected 1 to 1; a newer ceilvo wrote it"),
    ("version: 1", "version: '1'", r"version: found '1', expected 1 to 1"),
    ("version: 1", "version: true", r"version: found True, expected 1 to 1"),
    ("tile_m: 0.6", "tile: 0.6", r"tile: found an unknown key, expected one of version, created"),
    ("  kind: pinhole", "  sort: pinhole", r"camera\.kind: found nothing, expected a value"),
    ("kind: pinhole", "kind: lens", r"camera\.kind: found 'lens', expected pinhole or fisheye"),
    ("width_px: 640", "width_px: 640.0", r"camera\.width_px: found 640\.0, expected a whole number"),
    ("width_px: 640", "width_px: 0", r"camera\.width_px: found 0, expected 64 to 7680"),
    ("fx_px: 410.3", "fx_px: -410.3", r"camera\.fx_px: found -410\.3, expected 10 to 100000"),
    ("fx_px: 410.3", "fx_px: wide", r"camera\.fx_px: found 'wide', expected a finite number"),
    ("cx_px: 322.7", "cx_px: 3220.7", r"camera\.cx_px: found 3220\.7, expected -320 to 960"),
    ("-0.002]", "-0.002, 0]", r"camera\.distortion: found 6 numbers, expected 0, 4, 5 or 8 for pinhole"),
    ("-0.15,", "-150000.0,", r"camera\.distortion: found .*, expected coefficients of at most 1000"),
    ("distortion: [", "distortion: [[1], ", r"camera\.distortion\[0\]: found \[1\], expected a finite number"),
    ("tile_m: 0.6", "tile_m: 0.0", r"tile_m: found 0, expected 0\.05 to 10 or null"),
    ("sigma_y_m: [0.004", "sigma_y_m: [-0.004", r"noise\.sigma_y_m: found values from -0\.004 .* expected above 0"),
    ("sigma_x_m: [0.003, 0.0, 0.002]", "sigma_x_m: []", r"noise\.sigma_x_m: found 0 coefficients, expected 1 to 8"),
    ("r_max_m: 2.5", "r_max_m: 0", r"noise\.r_min_m, r_max_m: found 0 and 0, expected 0 <= r_min_m < r_max_m"),
    ("sigma_theta_rad: 0.002", "sigma_theta_rad: 0", r"noise\.sigma_theta_rad: found 0, expected above 0"),
    ("created: '2026-01-31'", "created: yesterday", r"created: found 'yesterday', expected an ISO date"),
    ("created: '2026-01-31'", "created: 5", r"created: found 5, expected up to 200 characters of text"),
    ("id: usb-0001", 'id: "a\\nb"', r"camera\.id: found 'a\\nb', expected up to 200 characters of text"),
    ("meta:", "meta: 5\nmeta_old:", r"meta_old: found an unknown key"),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG, ids=[f"{i}" for i in range(len(WRONG))])
def test_a_wrong_value_is_named(path: Path, old: str, new: str, message: str) -> None:
    edit(path, old, new)
    with pytest.raises(CalibrationError, match=message) as e:
        read_calibration(path)
    assert all(line.startswith(f"{path}: ") for line in e.value.problems)


NOT_A_CALIBRATION = [
    (b"", r"found no keys, expected a calibration"),
    (b"- 1\n", r"found no keys, expected a calibration"),
    (b"a: [\n", r":\d+: found text that is not YAML"),
    (b"a: 1\na: 2\n", r":2: found key 'a' twice"),
    (b"1: 2\n", r":1: found key 1, expected text"),
    (b"a: !!python/name:os.system x\n", r":1: found a value with the tag !!python/name:os\.system"),
    (b"a: !!set {x}\n", r":1: found a value with the tag !!set"),
    (b"a: &x [1]\nb: *x\n", r":2: found text that is not YAML \(an alias"),
    (b"a: " + b"[" * 30 + b"]" * 30, r":1: found nesting deeper than 20 levels"),
    (b"[" * 200_000, r"found nesting that is too deep"),
    (b"\xff\xfe", r":1: found byte 0xff, expected UTF-8"),
    (b"#" * (MAX_BYTES + 1), r"found more than 1048576 bytes"),
    (b"version: 1\nx: .nan\n", r"checksum: found None, expected 'none, because a number is not finite'"),
]


@pytest.mark.parametrize(("raw", "message"), NOT_A_CALIBRATION, ids=[f"{i}" for i in range(len(NOT_A_CALIBRATION))])
def test_what_is_not_a_calibration_is_refused(tmp_path: Path, raw: bytes, message: str) -> None:
    file = tmp_path / "k.yaml"
    file.write_bytes(raw)
    with pytest.raises(CalibrationError, match=message):
        read_calibration(file)


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"none\.yaml: found no such file"):
        read_calibration(tmp_path / "none.yaml")
    with pytest.raises(CalibrationError, match="found a folder"):
        read_calibration(tmp_path)


PROJECTIONS = {
    "height": (projection_matrix(LENS, np.eye(3), (0.0, 0.0), 40.0), r"found a ceiling 40 m above the camera"),
    "below": (projection_matrix(LENS, np.eye(3), (0.0, 0.0), -2.0), r"found a ceiling -2 m above the camera"),
    "sideways": (
        projection_matrix(LENS, mount_rotation(0.0, np.radians(85.0)), (0.0, 0.0), 2.0),
        r"found a camera 85 deg off the vertical",
    ),
    "beside": (projection_matrix(LENS, np.eye(3), (6.0, 0.0), 2.0), r"found a camera 6 m beside the base's origin"),
    "degenerate": (np.ones((3, 4)), r"found a left 3 x 3 block that is not the camera matrix times a rotation"),
    "sheared": (
        projection_matrix(LENS, np.eye(3), (0.0, 0.0), 2.0) @ np.diag([1.0, 2.0, 1.0, 1.0]),
        r"not the camera matrix times a rotation",
    ),
    "nan": (np.full((3, 4), np.nan), r"expected 3 x 4 finite numbers"),
    "shape": (np.eye(3), r"expected 3 x 4 finite numbers"),
}


@pytest.mark.parametrize("name", PROJECTIONS)
def test_a_projection_that_cannot_be_is_not_written(tmp_path: Path, name: str) -> None:
    m, message = PROJECTIONS[name]
    with pytest.raises(CalibrationError, match=message):
        write_calibration(tmp_path / "k.yaml", calibration(projection=m))
    assert not (tmp_path / "k.yaml").exists()


def test_all_wrong_values_come_at_once(tmp_path: Path) -> None:
    wrong = calibration(camera=dataclasses.replace(LENS, width_px=1, height_px=1), tile_m=99.0)
    with pytest.raises(CalibrationError) as e:
        write_calibration(tmp_path / "k.yaml", wrong)
    named = " ".join(e.value.problems)
    assert all(key in named for key in ("camera.width_px", "camera.height_px", "tile_m"))


def test_the_calibration_must_fit_the_camera() -> None:
    c = calibration()
    check_fits(c, "front", "usb-0001", 640, 480)
    check_fits(c, "front", "", 640, 480)
    check_fits(calibration(camera_id=""), "front", "usb-0002", 640, 480)
    with pytest.raises(CalibrationError) as e:
        check_fits(c, "/dev/video0", "usb-0002", 1280, 720)
    for part in ("/dev/video0", "1280 x 720 px, expected 640 x 480 px", "'usb-0002', expected 'usb-0001'"):
        assert part in str(e.value)
    with pytest.raises(CalibrationError, match="480 x 640 px, expected 640 x 480 px; use"):
        check_fits(c, "front", "usb-0001", 480, 640)


def test_an_old_version_is_migrated_step_by_step(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Version 1 is the first; this plays the day after the next change of layout."""
    edit(path, "tile_m: 0.6", "tile_mm: 600")
    monkeypatch.setattr(calibration_file, "VERSION", 3)
    monkeypatch.setattr(
        calibration_file,
        "_MIGRATIONS",
        {
            1: lambda c: {**{k: v for k, v in c.items() if k != "tile_mm"}, "tile_cm": c["tile_mm"] / 10},
            2: lambda c: {**{k: v for k, v in c.items() if k != "tile_cm"}, "tile_m": c["tile_cm"] / 100},
        },
    )
    assert same(read_calibration(path), calibration())


@pytest.mark.parametrize("readout_s", [0.02, -0.0125])
def test_a_rolling_shutter_is_kept_with_its_direction(path: Path, readout_s: float) -> None:
    rolling = calibration(camera=dataclasses.replace(LENS, readout_s=readout_s))
    write_calibration(path, rolling, force=True)
    assert f"readout_s: {readout_s}" in path.read_text()
    assert read_calibration(path).camera.readout_s == readout_s


def test_files_of_a_global_shutter_are_as_they_were(path: Path) -> None:
    assert "readout" not in path.read_text()
    assert read_calibration(path).camera.readout_s == 0.0


def test_a_readout_in_milliseconds_is_refused(tmp_path: Path) -> None:
    wrong = calibration(camera=dataclasses.replace(LENS, readout_s=20.0))
    with pytest.raises(CalibrationError, match=r"camera.readout_s: found 20, expected -0.2 to 0.2"):
        write_calibration(tmp_path / "k.yaml", wrong)
