"""What every recording needs: its frames, and settings that begin at a pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ceilvo.config import Config
from ceilvo.drivers.camera.selection import source_camera
from ceilvo.types import Array, Frame


def recorded(folder: Path) -> Iterator[Frame]:
    """Frames of a folder of pictures of 640x480, in order."""
    camera = source_camera(folder, 640, 480)
    camera.open()
    try:
        while (frame := camera.read()) is not None:
            yield frame
    finally:
        camera.close()


def starting_at(pose: Array) -> Config:
    """The default settings, from a pose (3,) on."""
    x, y, theta = (float(v) for v in pose)
    base = Config()
    start = replace(
        base.filter, initial_pose_x_m=x, initial_pose_y_m=y, initial_pose_theta_deg=float(np.degrees(theta))
    )
    return replace(base, filter=start)
