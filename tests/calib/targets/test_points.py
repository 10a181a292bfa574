"""calib projection from points: exactness, comparison with OpenCV, and layouts that are refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ceilvo.calib.solve.degeneracy import layout_problem
from ceilvo.calib.solve.dlt import dlt
from ceilvo.calib.solve.projection import from_points
from ceilvo.calib.targets.points_file import in_metres, read_points, read_table
from ceilvo.calibration import Calibration
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError
from ceilvo.sim.rig import simulated_calibration, simulated_camera

Array = NDArray[np.float64]

SIZE = (640, 480)
RIG = simulated_calibration(
    CameraModel("pinhole", 640, 480, 410.3, 409.1, 321.0, 238.0), roll_rad=0.05, pitch_rad=-0.03, yaw_rad=0.4
)


def project(rig: Calibration, xyz: Array) -> Array:
    """Independent of calib: eq. 5 as it stands."""
    s = np.column_stack([xyz, np.ones(len(xyz))]) @ rig.projection.T
    return np.asarray(s[:, :2] / s[:, 2:])


def points(seed: int, n: int, lower_m: float = 0.6) -> Array:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.6, 0.6, (n, 2)), rng.uniform(-lower_m, 0.0, n)])


@pytest.mark.parametrize("seed", range(5))
def test_dlt_is_exact_without_noise(seed: int) -> None:
    xyz = points(seed, 9)
    m = dlt(xyz, project(RIG, xyz))
    true = RIG.projection / np.linalg.norm(RIG.projection[2, :3])
    np.testing.assert_allclose(m, true, rtol=0, atol=1e-9 * np.abs(true).max())


@pytest.mark.parametrize("lower_m", [0.0, 0.6], ids=["planar", "spatial"])
@pytest.mark.parametrize("seed", range(3))
def test_a_known_lens_gives_the_mounting_exactly(seed: int, lower_m: float) -> None:
    lens = simulated_camera()
    rig = simulated_calibration(lens, roll_rad=0.05, pitch_rad=-0.03, yaw_rad=2.4)
    xyz = points(seed, 8, lower_m)
    p = np.array([*rig.mount_xy_m, -rig.ceiling_height_m])
    found = from_points(lens, xyz, lens.pixels((xyz - p) @ rig.camera_from_base.T))
    assert found.xy_m is not None and found.yaw_rad is not None
    got = np.array([found.roll_rad, found.pitch_rad, found.height_m, found.yaw_rad, *found.xy_m])
    np.testing.assert_allclose(got, [0.05, -0.03, 2.2, 2.4, 0.05, -0.03], rtol=0, atol=1e-9)


def test_noisy_points_are_as_good_as_opencvs_solvepnp() -> None:
    """0.3 px on both; compared by the position of the camera over 40 draws."""
    lens = RIG.camera
    ours, theirs, inside = [], [], 0
    for seed in range(40):
        xyz = points(seed, 12)
        uv = project(RIG, xyz) + np.random.default_rng([seed, 1]).normal(0, 0.3, (12, 2))
        found = from_points(lens, xyz, uv)
        assert found.xy_m is not None
        off = np.array([*(found.xy_m - RIG.mount_xy_m), found.height_m - RIG.ceiling_height_m])
        ours.append(off)
        inside += int(abs(off[2]) < 3.0 * found.sigma[2])
        _, rvec, tvec = cv2.solvePnP(xyz, uv, lens.matrix, np.zeros(5), flags=cv2.SOLVEPNP_ITERATIVE)
        at = -cv2.Rodrigues(rvec)[0].T @ np.ravel(tvec)
        theirs.append(at - np.array([*RIG.mount_xy_m, -RIG.ceiling_height_m]))
    assert np.sqrt(np.mean(np.square(ours))) <= 1.02 * np.sqrt(np.mean(np.square(theirs)))
    assert inside >= 37


GOOD = points(7, 10)
GOOD_UV = project(RIG, GOOD)
FLAT = GOOD * [1, 1, 0]
LINE = np.column_stack([np.linspace(-0.7, 0.7, 8), 0.3 * np.linspace(-0.7, 0.7, 8), np.zeros(8)])
BUT_ONE = np.vstack([LINE[:7], [0.2, 0.6, 0.0]])
TWICE = np.vstack([GOOD[:3]] * 3)
ONE_LOWER = np.vstack([FLAT[:9], [0.1, 0.1, -0.5]])
CLUSTER = np.array([0.1, 0.1, 0.0]) + 0.05 * points(3, 8)


LAYOUTS: list[tuple[str, Array, Array, bool, str]] = [
    ("too few", GOOD[:3], GOOD_UV[:3], True, "3 points, at least 4"),
    ("too few without lens", GOOD[:5], GOOD_UV[:5], False, "5 points, at least 6"),
    ("the same place again", TWICE, project(RIG, TWICE), True, "are different places"),
    ("one place, two pixels", np.vstack([GOOD, GOOD[:1]]), np.vstack([GOOD_UV, GOOD_UV[:1] + 60]), True, "same place"),
    ("two places, one pixel", GOOD, np.vstack([GOOD_UV[:9], GOOD_UV[:1]]), True, "same pixel"),
    ("one line", LINE, project(RIG, LINE), True, "all points are on one line"),
    ("all but one on a line", BUT_ONE, project(RIG, BUT_ONE), True, "all points but one are on one line"),
    ("plane without lens", FLAT, project(RIG, FLAT), False, "in one plane, which needs a known lens"),
    ("one lower only", ONE_LOWER, project(RIG, ONE_LOWER), False, "all points but 1 are in one plane"),
    ("cluster", CLUSTER, project(RIG, CLUSTER), True, "% of the picture"),
    ("mirrored", GOOD * [1, -1, 1], GOOD_UV, True, "mirror image"),
    ("outside", GOOD, np.add(GOOD_UV, [400, 0]), True, "outside the picture"),
    ("shuffled", FLAT, project(RIG, FLAT)[[3, 7, 1, 9, 5, 0, 8, 2, 6, 4]], True, "nothing to do with the points"),
    ("edge on", GOOD, np.column_stack([GOOD_UV[:, 0], np.full(10, 200.0)]), True, "one line in the picture"),
    ("not a number", GOOD, GOOD_UV * [1, np.nan], True, "not a number"),
]


@pytest.mark.parametrize(("xyz", "uv", "lens", "reason"), [x[1:] for x in LAYOUTS], ids=[x[0] for x in LAYOUTS])
def test_a_degenerate_layout_is_refused_with_its_own_reason(xyz: Array, uv: Array, lens: bool, reason: str) -> None:
    found = layout_problem(xyz, uv, SIZE, lens)
    assert reason in found
    assert sum(other[4] in found for other in LAYOUTS) == 1, "two layouts share a reason"


@pytest.mark.parametrize("seed", range(20))
def test_a_good_layout_is_not_refused(seed: int) -> None:
    xyz = points(seed, 10)
    assert layout_problem(xyz, project(RIG, xyz), SIZE, True) == ""
    assert layout_problem(xyz, project(RIG, xyz), SIZE, False) == ""


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def table(xyz: Array, uv: Array, header: str = "x_m,y_m,z_m,u_px,v_px") -> str:
    return "\n".join([header, *(",".join(f"{v:.6f}" for v in row) for row in np.column_stack([xyz, uv]))]) + "\n"


def test_points_are_read_back(tmp_path: Path) -> None:
    xyz, uv = read_points(write(tmp_path / "p.csv", table(GOOD, GOOD_UV)), None)
    np.testing.assert_allclose(xyz, GOOD, atol=1e-6)
    np.testing.assert_allclose(uv, GOOD_UV, atol=1e-6)


def test_millimetres_are_asked_about_and_never_guessed(tmp_path: Path) -> None:
    file = write(tmp_path / "p.csv", table(1e3 * GOOD, GOOD_UV))
    asked = []

    def answer(yes: bool) -> bool:
        return yes

    with pytest.raises(CalibrationError, match="looks like millimetres; pass --units mm"):
        read_points(file, None, lambda q: (asked.append(q), answer(False))[1])
    assert len(asked) == 1
    xyz, _ = read_points(file, None, lambda q: (asked.append(q), answer(True))[1])
    np.testing.assert_allclose(xyz, GOOD, atol=1e-6)
    xyz, _ = read_points(file, "mm", lambda q: pytest.fail("asked though told"))
    np.testing.assert_allclose(xyz, GOOD, atol=1e-6)


def test_metres_that_were_said_are_believed(tmp_path: Path) -> None:
    t = {"x_m": np.array([60.0])}
    assert in_metres(tmp_path, t, ("x_m",), "m", lambda q: pytest.fail("asked though told")) == t


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (table(GOOD, GOOD_UV, "u_px,v_px,z_m,x_m,y_m").replace("-", ""), "swapped|looks like millimetres|metres"),
        (table(GOOD, 0.001 * GOOD_UV), "u_px and v_px reach only"),
        (table(np.add(GOOD, [0, 0, 2.5]), GOOD_UV), "expected 0 on the ceiling"),
        ("x_m,y_m,u_px\n1,2,3\n", "column 'v_px' is missing"),
        ("x_m,y_m,z_m,u_px,v_px\n1,2,0,,4\n", "line 2: u_px: found '', expected a number"),
        ("x_m,y_m,z_m,u_px,v_px\n1,2,0,nan,4\n", "expected a number"),
        ("x_m,y_m,z_m,u_px,v_px\n1,2,0,1e300,4\n", "found '1e300', expected a number"),
        (f"x_m,y_m,z_m,u_px,v_px\n1,2,0,{'7' * 5000},4\n", r"found '7+\.\.\.7+', expected a number"),
        (f"x_m,y_m,z_m,u_px,v_px\n1,2,0,{'7' * 200_000},4\n", "line 2: field larger than"),
        ("x_m,y_m,z_m,u_px,v_px\n" + "1,2,0,3,4\n" * 1001, "found 1001 points, expected at most 1000"),
        ("\x1b[2J,y_m\n1,2\n", r"column 'x_m' is missing, found \?\[2J, y_m"),
        ("x_m,y_m,z_m,u_px,v_px\n", "no row under the header"),
        ("", "column 'x_m' is missing, found nothing"),
        ("x_m;y_m;z_m;u_px;v_px\n1;2;0;3;4\n", "with commas between .found semicolons or tabs. and points in numbers"),
        ("x_m,y_m,z_m,u_px,v_px\n0,5,0,4,0,3,4\n", "line 2: found 7 fields, expected 5; are there decimal commas"),
        ('x_m,y_m,z_m,u_px,v_px\n"0,5",2,0,3,4\n', "x_m: found '0,5', expected a number; write 0.5, not 0,5"),
    ],
    ids=[
        "columns swapped",
        "pixels in metres",
        "heights above the floor",
        "missing",
        "empty",
        "nan",
        "beyond all",
        "digits",
        "large field",
        "many",
        "escape",
        "bare",
        "nothing",
        "semicolons",
        "decimal commas",
        "quoted decimal commas",
    ],
)
def test_a_bad_list_is_refused_with_its_reason(tmp_path: Path, text: str, reason: str) -> None:
    with pytest.raises(CalibrationError, match=reason):
        read_points(write(tmp_path / "p.csv", text), None, lambda q: False)


def test_a_missing_list_is_named(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"none\.csv: cannot be read"):
        read_table(tmp_path / "none.csv", ("x_m",))
