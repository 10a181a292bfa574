"""What people bring to calib, and what it kept of earlier steps."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from functools import lru_cache
from typing import Any

import numpy as np

from ceilvo.bench.fuzz.engine.mutations import mutated_json
from ceilvo.bench.fuzz.engine.target import Target, file, folder, json_of, printed, rig
from ceilvo.calib.commands import circles, intrinsics
from ceilvo.calib.commands.report import report
from ceilvo.calib.commands.sigma import errors_of_csv
from ceilvo.calib.session import views
from ceilvo.calib.session.assemble import lens_so_far, update_file
from ceilvo.calib.session.session import Session
from ceilvo.calib.session.wheels import recorded
from ceilvo.calib.solve.degeneracy import layout_problem
from ceilvo.calib.solve.sigma import fit
from ceilvo.calib.targets.board import Board
from ceilvo.calib.targets.marks import read_marks
from ceilvo.calib.targets.points_file import read_points
from ceilvo.errors import CalibrationError
from ceilvo.json_values import json_value

_SIZE = (640, 480)


def _no(question: str) -> bool:
    return False


def _points(data: bytes) -> None:
    xyz, uv = read_points(file("points.csv", data), None, _no)
    layout_problem(xyz, uv, _SIZE, True)
    layout_problem(xyz, uv, _SIZE, False)


def _marks(data: bytes) -> None:
    read_marks(file("marks.csv", data), None, _no)


def _wheels(data: bytes) -> None:
    recorded(file("wheels/wheels.csv", data).parent)


def _errors(data: bytes) -> None:
    """`calib sigma --csv`, in either form."""
    fit(errors_of_csv(file("errors.csv", data), None))


def _pose(data: bytes) -> None:
    """What a person types."""
    circles.parse_pose(data.decode("utf-8", "replace"))


def _session(data: bytes) -> None:
    """File names with their content, of samples line by line; then every step's part of reading them."""
    session = _written(data)
    problems: list[CalibrationError] = []
    for part in (_report, _lens, _file, _board_samples, _ceiling_samples, _circle_samples):
        try:
            with printed():
                part(session)
        except CalibrationError as e:
            problems.append(e)
    if problems:
        raise problems[0]


def _written(data: bytes) -> Session:
    shutil.rmtree(folder() / "session", ignore_errors=True)
    (folder() / "session").mkdir()
    found = json_of(data)
    files = found if isinstance(found, dict) else {}
    for name in _NAMES:
        if name in files:
            lines = files[name] if name.endswith("l") and isinstance(files[name], list) else [files[name]]
            text = "\n".join(json.dumps(line) for line in lines)
            file(f"session/{name}", text.encode("utf-8", "surrogatepass"))
    return Session(folder() / "session")


def _report(session: Session) -> None:
    report(session)


def _lens(session: Session) -> None:
    lens_so_far(session, "a test")


def _file(session: Session) -> None:
    update_file(session)


def _board_samples(session: Session) -> None:
    intrinsics.kept(session, Board(), _SUBJECT)


def _ceiling_samples(session: Session) -> None:
    views.kept(session, "projection", _SUBJECT)


def _circle_samples(session: Session) -> None:
    samples = [r for r in circles.kept(session, _SUBJECT) if "rejected" not in r]
    circles.errors_of(rig(), samples)


# -- what to start from

_SUBJECT = {"source": "a", "size": list(_SIZE)}
_NAMES = (
    *("intrinsics.json", "projection.json", "mount.json", "sigma.json", "survey.json", "check.json"),
    *("intrinsics.samples.jsonl", "projection.samples.jsonl", f"{circles.SAMPLES}.samples.jsonl"),
)


@lru_cache
def _sessions() -> tuple[bytes, ...]:
    whole = json_value({**_results(), **_samples()})
    few = {name: whole[name] for name in (*_NAMES[:2], _NAMES[8])}
    return (json.dumps(whole).encode(), json.dumps(few).encode())


def _results() -> dict[str, Any]:
    good = {"problems": [], "verdict": "PASS"}
    n = 4 + len(rig().camera.distortion)
    lens = {"camera": asdict(rig().camera), "sigma": [0.1] * n, "cov": np.zeros((n, n)), "model": "pinhole"}
    projection = {"roll_rad": 0.01, "pitch_rad": -0.02, "height_m": 2.2, "yaw_rad": None, "xy_m": None, "tile_m": 0.6}
    curves = {"sigma_x_m": [0.001, 0.002], "sigma_y_m": [0.001, 0.002], "sigma_theta_rad": 0.001}
    return {
        "intrinsics.json": {**lens, "camera_id": "a", "rms_px": 0.1, "shots": [{"name": "a", "rms_px": 0.1}], **good},
        "projection.json": {**projection, "sigma": [0.001] * 3, "cov": np.eye(3), "rms_px": 0.1, **good},
        "mount.json": {"xy_m": [0.05, -0.03], "yaw_rad": 0.03, "sigma": [0.001] * 3, "wheel_scale": 1.0, **good},
        "sigma.json": {**curves, "r_min_m": 0.1, "r_max_m": 2.0, "samples": 500, "bias_m": [0.0, 0.0], **good},
        "survey.json": {"nis": 0.9, "of": ["1"], **good},
        "check.json": {"nis": 0.1, **good},
    }


def _samples() -> dict[str, Any]:
    corners = Board().corners_m[:, :2] * 1e3 + 50.0
    board = {"name": "a", "width_px": 640, "height_px": 480, "ids": list(range(len(corners))), "uv_px": corners}
    seen = {"name": "a", "label": "", "stamp_ns": 1, "uv_px": corners[:7], "xy": corners[:7] / 1e3}
    circle = {"x_m": 0.5, "y_m": 0.1, "theta_rad": 0.2, "seen_x_m": -0.5, "seen_y_m": 0.0, "psi_rad": 0.1}
    return {
        _NAMES[6]: [_SUBJECT, board],
        _NAMES[7]: [_SUBJECT, {**seen, "psi_rad": 0.1, "psi_sigma_rad": 0.01, "wheels": [0.0, 0.1, 0.2]}],
        _NAMES[8]: [_SUBJECT, circle, {**circle, "x_m": 0.8}, {"rejected": "dark"}],
    }


_POINTS = b"x_m,y_m,z_m,u_px,v_px\n" + b"".join(
    b"%.3f,%.3f,%.3f,%.2f,%.2f\n" % (x, y, -0.1 * (x > 0), 320 + 186 * y, 240 - 186 * x)
    for x in (-0.8, -0.1, 0.5, 0.9)
    for y in (-1.2, 0.2, 1.1)
)
_MEASURED = b"x_m,y_m,theta_rad,seen_x_m,seen_y_m,seen_theta_rad\n" + b"".join(
    b"%.3f,0.0,0.0,%.4f,%.4f,%.4f\n" % (-r, r + 1e-4 * (k % 3), 1e-4 * k, 1e-3 * (k - 2))
    for r in (0.5, 1.0, 1.5)
    for k in range(6)
)
_OFF = b"r_m,dx_m,dy_m,dtheta_rad\n" + b"".join(
    b"%.2f,%.4f,%.4f,%.4f\n" % (r, 1e-3 * (k % 3 - 1), 1e-3 * (k % 2), 1e-3 * (k - 3))
    for r in (0.5, 1.0, 1.5)
    for k in range(6)
)

TARGETS = {
    "calib_points": Target(_points, lambda: (_POINTS,)),
    "calib_marks": Target(_marks, lambda: (b"x_m,y_m,z_m,id\n0.1,0.2,0,4\n1.1,0.2,-0.1,7\n", b"x_m,y_m\n0.1,0.2\n")),
    "calib_wheels": Target(_wheels, lambda: (b"name,x_m,y_m,theta_rad\na.png,0,0,0\nb.png,1,2,0.5\n",)),
    "calib_errors": Target(_errors, lambda: (_MEASURED, _OFF)),
    "calib_pose": Target(_pose, lambda: (b"0.5, 1.0 90",)),
    "calib_session": Target(_session, _sessions, mutated_json),
}
