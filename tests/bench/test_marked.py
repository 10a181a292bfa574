"""The judge of marked photographs, on lines of known recall; and the files of marks themselves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceilvo.bench.real.marked import reading
from ceilvo.bench.real.marked.judging import ANGLE_DEG, OFFSET_PX, Judged, judge
from ceilvo.bench.real.marked.photographs import look, photographs
from ceilvo.bench.real.marked.reading import HERE, Marked, all_marked
from ceilvo.bench.real.marked.standing import stand
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.errors import FileFormatError
from ceilvo.types import Array, LineKind, Lines

CAMERA = CameraModel("pinhole", 640, 480, 410.0, 410.0, 319.5, 239.5)
CALIBRATION = Calibration(
    CAMERA,
    projection_matrix(CAMERA, mount_rotation(0.0), (0.0, 0.0), 2.5),
    NoiseCurves((0.05,), (0.05,), sigma_theta_rad=0.02, r_min_m=0.0, r_max_m=6.0),
)
VIEW_DEG = 70.0
UP = (100.0, 200.0, 300.0, 400.0)
"""x of four marked joints, raw px, from y 100 to 300; the camera looks straight up through no lens."""


def marked(rows: list[tuple[float, float, float, float]], kinds: str = "joint", contrast: float = 9.0) -> Marked:
    whole = np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]])
    corner = np.array([[500.0, 0.0], [639.0, 0.0], [639.0, 479.0], [500.0, 479.0]])
    ends = np.array(rows).reshape(-1, 2, 2)
    return Marked(
        "x", Path("x"), CALIBRATION, ends, (kinds,) * len(ends), np.full(len(ends), contrast), whole, (corner,)
    )


def found(rows: list[tuple[float, float, float]], turn_deg: float = 0.0, kind: LineKind = LineKind.RISING) -> Lines:
    """Lines at raw x, from y to y, turned about the middle of their place; points stand a pixel apart."""
    view = CALIBRATION.level_view
    centre = np.array([CAMERA.cx_px, CAMERA.cy_px])
    ends = np.array([[[x, a], [x, b]] for x, a, b in rows], np.float64).reshape(-1, 2, 2)
    level = view.from_raw(ends.reshape(-1, 2)).reshape(-1, 2, 2) - centre
    along = level[0, 1] - level[0, 0]
    psi = float(np.arctan2(along[1], along[0]) - 0.5 * np.pi + np.radians(turn_deg))
    normal, tangent = np.array([np.cos(psi), np.sin(psi)]), np.array([-np.sin(psi), np.cos(psi)])
    middle, half = level.mean(axis=1), 0.5 * np.hypot(*(level[:, 1] - level[:, 0]).T)
    points, index = [], []
    for k in range(len(rows)):
        t = np.arange(-half[k], half[k] + 1.0)
        points.append(middle[k] + t[:, None] * tangent)
        index += [k] * len(t)
    n, two = len(rows), np.zeros(2)
    return Lines(
        psi_rad=psi,
        psi_sigma_rad=0.001,
        axis=np.zeros(n, np.int64),
        offset_px=middle @ normal,
        sigma_px=np.full(n, 0.1),
        kind=np.full(n, int(kind)),
        support=np.bincount(index, minlength=n),
        tilt_rad=two,
        tilt_sigma_rad=two,
        free_tilt_rad=two,
        free_tilt_sigma_rad=two,
        points=np.concatenate(points).astype(np.float32),
        point_line=np.array(index),
    )


def judged(lines: list[tuple[float, float, float]], truth: Marked, **more: float) -> Judged:
    return judge(found(lines, **more), truth, VIEW_DEG)


JOINTS = [(x, 100.0, x, 300.0) for x in UP]


def test_what_was_found_of_the_marked_length_is_the_recall() -> None:
    j = judged([(100.0, 100.0, 300.0), (200.0, 100.0, 200.0), (300.0, 100.0, 300.0)], marked(JOINTS))
    assert j.recall_joints == pytest.approx(2.5 / 4.0, abs=0.03)
    assert j.found == pytest.approx([1.0, 0.5, 1.0, 0.0], abs=0.05)
    assert j.true.all()
    assert j.spurious_share == 0.0


@pytest.mark.parametrize(("off_px", "counts"), [(0.0, True), (OFFSET_PX - 0.5, True), (OFFSET_PX + 0.5, False)])
def test_a_line_beside_its_mark_counts_within_the_tolerance(off_px: float, counts: bool) -> None:
    for side in (-1.0, 1.0):
        j = judged([(x + side * off_px, 100.0, 300.0) for x in UP], marked(JOINTS))
        assert j.recall_joints == pytest.approx(float(counts), abs=0.03)
        assert j.true.tolist() == [counts] * 4
        assert j.spurious.tolist() == [not counts] * 4
        assert j.on_marks == pytest.approx(float(counts), abs=0.03)


@pytest.mark.parametrize("turn", [-1.0, 1.0])
def test_a_line_across_a_mark_is_none_of_it(turn: float) -> None:
    rows = [(x, 190.0, 210.0) for x in UP]
    assert judged(rows, marked(JOINTS), turn_deg=turn * (ANGLE_DEG - 1.0)).true.all()
    assert judged(rows, marked(JOINTS), turn_deg=turn * (ANGLE_DEG + 1.0)).spurious.all()


def test_spurious_lines_are_those_on_no_mark_and_within_the_ceiling() -> None:
    lines = [(100.0, 100.0, 300.0), (150.0, 100.0, 300.0), (250.0, 100.0, 300.0), (550.0, 100.0, 300.0)]
    j = judged(lines, marked(JOINTS))
    assert j.true.tolist() == [True, False, False, False]
    assert j.spurious.tolist() == [False, True, True, False]
    assert j.apart.tolist() == [False, False, False, True], "a pattern of its own is counted by itself"
    assert j.spurious_share == pytest.approx(2.0 / 3.0)
    assert j.on_marks == pytest.approx(1.0 / 3.0, abs=0.02)


def test_a_line_that_goes_on_beyond_its_mark_is_true_while_most_of_it_is() -> None:
    assert judged([(100.0, 100.0, 460.0)], marked(JOINTS)).true.all()
    assert judged([(100.0, 20.0, 460.0)], marked([(100.0, 100.0, 100.0, 300.0)])).spurious.all()


def test_only_joints_that_stand_out_are_asked_for() -> None:
    lines = [(100.0, 100.0, 300.0)]
    assert np.isnan(judged(lines, marked(JOINTS, contrast=2.0)).recall_joints)
    assert np.isnan(judged(lines, marked(JOINTS, kinds="pipe")).recall_joints)
    assert judged(lines, marked(JOINTS, kinds="pipe")).recall_all == pytest.approx(0.25, abs=0.02)


def test_joints_far_off_the_vertical_are_told_apart() -> None:
    """The corner of the picture is 44 deg off the vertical, of a wider camera 53."""
    near, far = (300.0, 200.0, 300.0, 280.0), (5.0, 2.0, 5.0, 20.0)
    j = judge(found([(300.0, 200.0, 280.0)]), marked([near, far]), VIEW_DEG)
    assert j.recall_joints == pytest.approx(80.0 / 98.0, abs=0.02)
    assert np.isnan(j.recall_far)
    wide = CameraModel("pinhole", 640, 480, 300.0, 300.0, 319.5, 239.5)
    one = marked([near, far])
    projection = projection_matrix(wide, mount_rotation(0.0), (0.0, 0.0), 2.5)
    seen = replace(one, calibration=replace(CALIBRATION, camera=wide, projection=projection))
    assert judge(found([(300.0, 200.0, 280.0)]), seen, VIEW_DEG).recall_far == 0.0


def test_the_middle_of_a_bar_is_a_groove_between_its_two_edges() -> None:
    bar = marked([(200.0, 100.0, 200.0, 300.0), (208.0, 110.0, 208.0, 300.0)])
    assert judged([(204.0, 100.0, 300.0)], bar).true.all()
    far = marked([(200.0, 100.0, 200.0, 300.0), (220.0, 110.0, 220.0, 300.0)])
    assert judged([(210.0, 100.0, 300.0)], far).spurious.all()


def test_both_sides_of_a_groove_are_found_with_it() -> None:
    """Its points lie on the sides, and the marks are the sides."""
    lines = found([(204.0, 100.0, 300.0)], kind=LineKind.GROOVE)
    side = np.where(np.arange(len(lines.points)) % 2, 5.0, -5.0)
    normal = np.array([np.cos(lines.psi_rad), np.sin(lines.psi_rad)])
    lines.points[:] += (side[:, None] * normal).astype(np.float32)
    truth = marked([(204.0 + d, 100.0, 204.0 + d, 300.0) for d in (-5.0, 5.0)])
    assert judge(lines, truth, VIEW_DEG).recall_joints == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("m", all_marked(), ids=lambda m: m.name)
def test_files_of_marks_are_well_formed(m: Marked) -> None:
    camera = m.calibration.camera
    size = np.array([camera.width_px, camera.height_px])
    assert len(m.ends) == len(m.kind) == len(m.contrast) > 20
    assert np.all((m.ends > -1.0) & (m.ends < size)), "ends are in the picture"
    assert np.hypot(*(m.ends[:, 1] - m.ends[:, 0]).T).min() > 10.0
    assert np.all(m.contrast >= 0.0)
    outline = m.ceiling.astype(np.float32)
    inside = [cv2.pointPolygonTest(outline, p.mean(axis=0).tolist(), False) >= 0 for p in m.ends]
    assert np.mean(inside) > 0.8, "most marks are in the ceiling that is looked at"
    first = (HERE / f"{m.name}.yaml").read_text(encoding="ascii").split("picture:")[0]
    assert "How: by " in first, "who reads the figures must know how the truth was made"
    assert str(m.picture) in first
    directions = m.calibration.level_view.from_raw(m.ends.reshape(-1, 2)).reshape(-1, 2, 2)
    along = directions[:, 1] - directions[:, 0]
    off = np.abs(np.mod(np.degrees(np.arctan2(along[:, 1], along[:, 0])) + 45.0, 90.0) - 45.0)
    assert np.median(off) < 1.0, "seen by the calibration, marks lie along base's axes"


@pytest.mark.parametrize("wrong", ["lines: 5", "kind", "nothing"])
def test_a_file_that_is_none_is_refused_by_name(wrong: str, tmp_path: Path) -> None:
    text = (HERE / "ceiling_still.yaml").read_text(encoding="ascii")
    file = tmp_path / "bad.yaml"
    changed = {"lines: 5": text.split("lines:")[0] + wrong, "kind": text.replace("joint,", "crack,"), "nothing": ""}
    file.write_text(changed[wrong], encoding="ascii")
    with pytest.raises(FileFormatError, match=r"bad\.yaml"):
        reading.read(file)


def test_absent_pictures_are_left_out_with_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert photographs(tmp_path, tmp_path / "out") == {}
    said = capsys.readouterr().out
    assert all(f"{m.name}: left out" in said for m in all_marked())


def test_another_picture_of_that_name_is_refused(tmp_path: Path) -> None:
    m = all_marked()[0]
    file = tmp_path / m.picture
    file.parent.mkdir()
    cv2.imwrite(str(file), np.zeros((10, 20), np.uint8))
    with pytest.raises(FileFormatError, match=r"20x10 px, expected the picture of 640x480"):
        m.gray(tmp_path)


def tiles() -> Array:
    """A picture of joints along both axes, 100 px apart, dark by 20 grey levels."""
    gray = np.full((CAMERA.height_px, CAMERA.width_px), 120, np.uint8)
    gray[40::100, :] = gray[41::100, :] = 100
    gray[:, 20::100] = gray[:, 21::100] = 100
    return np.asarray(cv2.GaussianBlur(gray, (3, 3), 0))


def test_a_drawn_ceiling_is_found_whole_and_the_robot_under_it_knows_its_place() -> None:
    rows = [(x + 0.5, 5.0, x + 0.5, 470.0) for x in range(20, 640, 100)]
    gray = tiles().astype(np.uint8)
    lines, j = look(gray, marked(rows))
    assert j.recall_joints > 0.95
    assert np.sum(j.true[lines.axis == lines.axis[np.flatnonzero(j.true)[0]]]) >= 5
    stood = stand(gray, CALIBRATION, frames=12)
    assert stood.frames["INIT"] + stood.good == 12
    assert stood.good >= 6
    assert stood.spread_m < 0.002


def test_a_robot_under_nothing_claims_nothing() -> None:
    stood = stand(np.full((CAMERA.height_px, CAMERA.width_px), 90, np.uint8), CALIBRATION, frames=6)
    assert stood.good == 0
    assert stood.good_spread_m == 0.0
