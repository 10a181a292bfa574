"""The paper's experiment with a person at the terminal: measured poses on circles about a feature, pictures of each."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calib.session.common import check_size
from ceilvo.calib.session.session import Session
from ceilvo.calib.solve.sigma import MIN_CIRCLES, MIN_PER_CIRCLE, Errors
from ceilvo.calib.targets.ceiling_view import CeilingReader
from ceilvo.calib.targets.sources import Picture, Source
from ceilvo.calibration import Calibration, in_base, mount_angles
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]
Prompt = Callable[[int, str], str]
"""How many poses there were, and the question."""
Take = Callable[[int], Picture]
Note = Callable[[str], None]

SAMPLES = "sigma-circles"
_MEASURED = ("x_m", "y_m", "theta_rad", "seen_x_m", "seen_y_m", "psi_rad")
"""Numbers of a sample that was not rejected."""
_NEAR_M = 0.15
"""From where the feature was measured: a quarter of a tile, so that it is no neighbour."""
_FAR_M = 20.0
"""From the feature: beyond it, it is not in view, and the numbers are millimetres."""
_ASK = "x y heading of the robot, in m and deg from the feature (Enter: done): "


def terminal_prompt(_: int, question: str) -> str:
    """One line; the end of input means done."""
    try:
        return input(question)
    except EOFError:
        return ""


def parse_pose(text: str) -> Array | str:
    """(3,) x m, y m, heading rad, or why not. Millimetres and radians mistaken for degrees are refused, not guessed."""
    words = text.replace(",", " ").split()
    try:
        x, y, heading = (float(w) for w in words)
    except ValueError:
        return f"found {text!r}, expected three numbers: x y heading"
    if not np.isfinite([x, y, heading]).all():
        return f"found {text!r}, expected numbers"
    if max(abs(x), abs(y)) > _FAR_M:
        return f"{max(abs(x), abs(y)):g} m looks like millimetres, expected metres"
    if abs(heading) > 360.0:
        return f"a heading of {heading:g}, expected degrees up to 360"
    return np.array([x, y, np.radians(heading)])


def collect(
    calibration: Calibration,
    session: Session,
    subject: dict[str, Any],
    take: Take,
    tilt_rad: tuple[float, float],
    prompt: Prompt,
    note: Note,
) -> list[dict[str, Any]]:
    """Ask for a pose, look once, keep what was seen, until a line is empty; an interrupted run goes on.

    Returns:
        Samples with x_m, y_m, theta_rad as measured, seen_x_m, seen_y_m in base, psi_rad the joints' direction in it.

    Raises:
        CalibrationError: there are no more pictures, or the disk refuses.
    """
    records = kept(session, subject)
    if records:
        note(f"going on after {len(records)} poses of the run before")
    reader = CeilingReader(calibration.camera, tilt_rad)
    while True:
        samples = [r for r in records if "rejected" not in r]
        text = prompt(len(records), f"pose {len(records) + 1}, {_progress(samples)}; {_ASK}")
        if not text.strip():
            return samples
        pose = parse_pose(text)
        if isinstance(pose, str):
            note(pose)
            continue
        picture = take(len(records))
        record = look(calibration, reader, picture, pose)
        session.add_sample(SAMPLES, record)
        records.append(record)
        if "rejected" in record:
            note(f"rejected, {record['rejected']}")
            continue
        off = np.array([record["seen_x_m"], record["seen_y_m"]]) - expected(pose)
        note(f"feature seen {1e3 * np.hypot(*off):.1f} mm from where it was measured")


def kept(session: Session, subject: dict[str, Any]) -> list[dict[str, Any]]:
    """Samples of an interrupted run, those that were rejected too.

    Raises:
        CalibrationError: they are of something else, or damaged.
    """
    records = session.samples(SAMPLES, subject)
    with session.reading_samples(SAMPLES):
        return [r if "rejected" in r else {k: _finite(r[k]) for k in _MEASURED} for r in records]


def _finite(value: Any) -> float:
    number = float(value)
    if not np.isfinite(number):
        raise ValueError(f"found {number}, expected a number")
    return number


def taker(source: Source) -> Take:
    """Of a folder the picture of that number; of a camera one that was exposed after it was asked for.

    Raises:
        CalibrationError: there are no more pictures; samples so far are kept.
    """
    stream, next_number = iter(source), 0

    def take(number: int) -> Picture:
        nonlocal next_number
        asked_ns = time.monotonic_ns()
        for picture in stream:
            next_number += 1
            if picture.stamp_ns >= asked_ns if source.info.live else next_number > number:
                return picture
        raise CalibrationError("sigma: found no more pictures, expected one for each pose; what was taken is kept")

    return take


def expected(pose: Array) -> Array:
    """(2,) the feature, at the origin of the measured poses, in base."""
    return np.asarray(se2.transform(se2.inverse(pose), np.zeros((1, 2)))[0])


def look(calibration: Calibration, reader: CeilingReader, picture: Picture, pose: Array) -> dict[str, Any]:
    """A sample: the crossing nearest to where the feature was measured; or why there is none."""
    size = (calibration.camera.width_px, calibration.camera.height_px)
    problem = picture.problem or check_size(picture, size, "calibrated are")
    view = None if problem else reader(picture.gray)
    if view is None or not view.ok:
        return {"rejected": problem or (view.reason if view is not None else "")}
    xy = in_base(calibration, view.uv_px)
    d = np.hypot(*(xy - expected(pose)).T)
    k = int(np.argmin(d))
    if d[k] > _NEAR_M:
        return {
            "rejected": f"the nearest crossing is {d[k]:.2f} m from where the feature was measured, "
            f"{_NEAR_M:g} allowed: are x, y and heading right?"
        }
    psi = view.psi_rad + mount_angles(calibration.camera_from_base)[0]
    return {
        "x_m": float(pose[0]), "y_m": float(pose[1]), "theta_rad": float(pose[2]),
        "seen_x_m": float(xy[k, 0]), "seen_y_m": float(xy[k, 1]), "psi_rad": psi,
    }  # fmt: skip


def _progress(samples: list[dict[str, Any]]) -> str:
    r = np.array([np.hypot(s["x_m"], s["y_m"]) for s in samples])
    near = ", ".join(f"{np.sum(np.round(r, 1) == at)} at {at:.1f} m" for at in np.unique(np.round(r, 1)))
    return f"{near or 'none yet'} ({MIN_CIRCLES} circles of {MIN_PER_CIRCLE} or more needed)"


def errors_of(calibration: Calibration, samples: list[dict[str, Any]]) -> Errors:
    """Seen minus measured. Headings are compared with the joints' direction, whose angle to the person's axes, being
    the same for all, is taken from their mean."""
    if not samples:
        raise CalibrationError("sigma: found no pose, expected three circles of six or more")
    pose = np.array([[s["x_m"], s["y_m"], s["theta_rad"]] for s in samples])
    true = np.array([expected(p) for p in pose])
    off = np.array([[s["seen_x_m"], s["seen_y_m"]] for s in samples]) - true
    turn = np.array([s["psi_rad"] for s in samples]) + pose[:, 2]
    mean = np.angle(np.exp(4j * turn).mean())
    dtheta = np.angle(np.exp(1j * (4.0 * turn - mean))) / 4.0
    r = np.hypot(*(true - calibration.mount_xy_m).T)
    return Errors(r, off[:, 0], off[:, 1], dtheta * np.sqrt(len(dtheta) / max(len(dtheta) - 1, 1)))
