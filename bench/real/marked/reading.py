"""The files of marks, and the camera that took each picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo import yaml_nodes
from ceilvo.calibration import Calibration, NoiseCurves, mount_rotation, projection_matrix
from ceilvo.camera import CameraModel
from ceilvo.errors import FileFormatError
from ceilvo.types import Array

HERE = Path(__file__).parent
JOINT = "joint"
KINDS = (JOINT, "beam", "lamp", "rail", "pipe", "duct", "tray", "bracket", "fixture", "wall")
CEILING_M = 3.0
"""Of every hall, for nobody measured one; it scales what is said in metres, and no figure in pixels."""
_NOISE = NoiseCurves((0.05,), (0.05,), sigma_theta_rad=0.02, r_min_m=0.0, r_max_m=6.0)
"""m, m, rad; chosen: nobody measured the noise of these cameras."""


@dataclass(frozen=True, slots=True)
class Marked:
    """What is true of one picture; all places in raw pixels.

    Attributes:
        name: of the file of marks, without its ending.
        picture: path below the folder of recordings.
        calibration: the camera, CEILING_M below the ceiling.
        ends: (L, 2, 2) of the straight edges.
        kind: L of KINDS; JOINT is of the ceiling's main plane.
        contrast: (L,) grey levels.
        ceiling: (V, 2) corners of what is looked at.
        apart: polygons within it that are counted by themselves, by (V, 2) corners.
    """

    name: str
    picture: Path
    calibration: Calibration
    ends: Array
    kind: tuple[str, ...]
    contrast: Array
    ceiling: Array
    apart: tuple[Array, ...]

    def gray(self, data: Path) -> NDArray[np.uint8] | None:
        """(H, W) from the folder of recordings; None where it is absent."""
        file = data / self.picture
        if not file.is_file():
            return None
        image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        camera = self.calibration.camera
        if image is None or image.shape != (camera.height_px, camera.width_px):
            found = "no image that OpenCV can read" if image is None else f"{image.shape[1]}x{image.shape[0]} px"
            raise FileFormatError(f"{file}: {found}, expected the picture of {camera.width_px}x{camera.height_px} px")
        return np.asarray(image, np.uint8)


def all_marked() -> list[Marked]:
    """Of all pictures, by name."""
    return [read(file) for file in sorted(HERE.glob("*.yaml"))]


def read(file: Path) -> Marked:
    """One file of marks."""
    content = yaml_nodes.plain(yaml_nodes.parse(yaml_nodes.read_text(file)))
    try:
        rows = content["lines"]
        kind = tuple(str(row[4]) for row in rows)
        if odd := set(kind) - set(KINDS):
            raise ValueError(f"kinds {sorted(odd)}, of which {', '.join(KINDS)} are known")
        return Marked(
            name=file.stem,
            picture=Path(str(content["picture"])),
            calibration=_calibration(content, file.stem),
            ends=np.array([row[:4] for row in rows], np.float64).reshape(-1, 2, 2),
            kind=kind,
            contrast=np.array([row[5] for row in rows], np.float64),
            ceiling=np.array(content["ceiling"], np.float64).reshape(-1, 2),
            apart=tuple(np.array(a["corners"], np.float64).reshape(-1, 2) for a in content["apart"]),
        )
    except (KeyError, IndexError, TypeError, ValueError) as e:
        raise FileFormatError(f"{file}: {e!r}; expected marks as in {HERE.name}/ceiling_still.yaml") from None


def _calibration(content: Any, name: str) -> Calibration:
    c = content["camera"]
    (fx, fy), (cx, cy) = c["focal_px"], c["centre_px"]
    camera = CameraModel("pinhole", c["width_px"], c["height_px"], fx, fy, cx, cy, tuple(c["distortion"]))
    yaw, roll, pitch = np.radians(content["mount_deg"]).tolist()
    projection = projection_matrix(camera, mount_rotation(yaw, roll, pitch), (0.0, 0.0), CEILING_M)
    return Calibration(camera, projection, _NOISE, name)
