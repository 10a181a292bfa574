"""Marks on the ceiling whose places were measured: found in pictures as ArUco markers, or clicked in one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.targets.points_file import Ask, in_metres, read_table
from ceilvo.calib.targets.sources import Picture
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]
Click = Callable[..., Array]
"""A picture, the marks' names in order and, for practice, their true pixels, to (N, 2) pixels."""

_TWO = 2
"""Marks in one picture, between which there is a way."""
_STILL_PX = 1.0
"""That a marker may move between pictures of a robot that stands."""


@dataclass(frozen=True)
class Marks:
    """What was measured: names, xyz_m (N, 3) in base, ids of markers (None: no markers, to be clicked)."""

    names: list[str]
    xyz_m: Array
    ids: list[int] | None


def read_marks(path: Path, units: str | None, ask: Ask) -> Marks:
    """CSV x_m,y_m[,z_m][,id]: with id the marks are ArUco markers, measured at their middle.

    Raises:
        CalibrationError: unreadable, a marker twice, or millimetres that nobody has confirmed.
    """
    table = read_table(path, ("x_m", "y_m"), ("z_m", "id"))
    table.setdefault("z_m", np.zeros(len(table["x_m"])))
    table = in_metres(path, table, ("x_m", "y_m", "z_m"), units, ask)
    xyz = np.column_stack([table["x_m"], table["y_m"], table["z_m"]])
    if "id" not in table:
        return Marks([f"mark {i + 1} at {x:g}, {y:g} m" for i, (x, y, _) in enumerate(xyz)], xyz, None)
    ids = [round(float(v)) for v in table["id"]]
    if len(set(ids)) < len(ids):
        raise CalibrationError(f"{path}: id: found a marker twice, expected each once")
    return Marks([f"marker {i}" for i in ids], xyz, ids)


def detected(marks: Marks, pictures: Iterable[Picture], dictionary: str, least: int) -> tuple[Array, Array, int]:
    """xyz_m (K, 3) and mean uv_px (K, 2) of the markers that were seen, over pictures of a robot that stands still.

    Raises:
        CalibrationError: the dictionary is not known, the camera moved, or fewer than `least` markers were seen.
    """
    detector = _detector(dictionary)
    wanted = marks.ids or []
    seen: dict[int, list[Array]] = {i: [] for i in wanted}
    count = 0
    for picture in pictures:
        count += 1
        for i, uv in _markers(detector, picture.gray).items():
            if i in seen:
                seen[i].append(uv)
    found = [k for k, i in enumerate(wanted) if seen[i]]
    if len(found) < least:
        raise CalibrationError(
            f"marks: found {len(found)} of {len(wanted)} markers in {count} pictures, at least {least} needed; "
            "are they flat, in focus, of the right --dictionary, with a white margin?"
        )
    spread = max(float(np.ptp(seen[wanted[k]], axis=0).max()) for k in found)
    if spread > _STILL_PX:
        raise CalibrationError(
            f"marks: a marker moved by {spread:.1f} px from picture to picture, {_STILL_PX:g} allowed; let it stand"
        )
    uv = np.array([np.mean(seen[wanted[k]], axis=0) for k in found])
    return marks.xyz_m[found], uv, count


def together(marks: Marks, pictures: Iterable[Picture], dictionary: str) -> list[tuple[Array, Array]]:
    """xyz_m (K, 3) and uv_px (K, 2) of each picture that shows two of the markers or more; the robot may move.

    Raises:
        CalibrationError: the dictionary is not known, or no picture shows two.
    """
    detector, out, most, count = _detector(dictionary), [], 0, 0
    for picture in pictures:
        count += 1
        seen = _markers(detector, picture.gray)
        rows = [k for k, i in enumerate(marks.ids or []) if i in seen]
        most = max(most, len(rows))
        if len(rows) >= _TWO and marks.ids is not None:
            out.append((marks.xyz_m[rows], np.array([seen[marks.ids[k]] for k in rows])))
    if not out:
        raise CalibrationError(
            f"marks: found at most {most} of the markers in one of {count} pictures, expected {_TWO}; "
            "are they flat, in focus, of the right --dictionary, with a white margin?"
        )
    return out


def _detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    number = getattr(cv2.aruco, f"DICT_{dictionary}", None)
    if number is None:
        raise CalibrationError(f"--dictionary: found {dictionary!r}, expected for example 5X5_100")
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number))
    detector.setDetectorParameters(_fine())
    return detector


def _markers(detector: cv2.aruco.ArucoDetector, gray: Gray) -> dict[int, Array]:
    """Middle of each marker in a picture, raw pixels, by its id."""
    corners, ids, _ = detector.detectMarkers(gray)
    middles = [_middle(np.asarray(quad, np.float64).reshape(4, 2)) for quad in corners]
    return {int(i): uv for i, uv in zip([] if ids is None else np.ravel(ids), middles, strict=True)}


def _fine() -> cv2.aruco.DetectorParameters:
    p = cv2.aruco.DetectorParameters()
    p.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return p


def _middle(quad: Array) -> Array:
    """Where the diagonals meet: the middle of a square seen in perspective."""
    a, b, c, d = (np.array([*p, 1.0]) for p in quad)
    m = np.cross(np.cross(a, c), np.cross(b, d))
    return np.asarray(m[:2] / m[2])


def clicked(marks: Marks, pictures: Iterable[Picture], click: Click) -> tuple[Array, Array, int]:
    """xyz_m and uv_px of all marks, clicked in the mean of the pictures."""
    grays = [p.gray for p in pictures]
    if not grays or len({g.shape for g in grays}) > 1:
        raise CalibrationError(f"marks: found {len(grays)} usable pictures of one size, at least 1 needed")
    mean = np.asarray(np.rint(np.mean(grays, axis=0)), np.uint8)
    return marks.xyz_m, click(mean, marks.names), len(grays)
