"""The lines that the crossings of a frame lie on, as distances from the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceilvo.daemon.odometry import kernel
from ceilvo.se2 import rotation
from ceilvo.types import Array, Crossings, Ints

_SAME_M = 0.002
"""Crossings of one line have one distance; those of another are 3 px away, 16 mm under an office ceiling."""
_QUARTER_RAD = 0.5 * np.pi


@dataclass(frozen=True, slots=True)
class SeenLines:
    """Lines of one frame, of two fixed perpendicular normals.

    Attributes:
        axis: (L,) 0 or 1, which normal.
        kind: (L,) LineKind along it.
        apparent_m: (L,) distance from the camera along it, were the line at the calibrated height.
        of_crossing: (M, 2) the lines of each crossing: on axis 0 and axis 1 of the frame.
        normals: (2, 2) rows: the frame's own normals in base.
    """

    axis: Ints
    kind: Ints
    apparent_m: Array
    of_crossing: Ints
    normals: Array

    def __len__(self) -> int:
        return len(self.axis)

    @staticmethod
    def of(crossings: Crossings, mount_xy_m: Array, turned_rad: float) -> SeenLines:
        """turned_rad: of base against the fixed axes, to well within 45 deg of what the lines' direction says."""
        normals = rotation(crossings.psi_rad).T
        from_camera = (crossings.xy_base_m - mount_xy_m) @ normals.T
        quarters = round((crossings.psi_rad + turned_rad) / _QUARTER_RAD)
        return SeenLines(*kernel.lines_seen(from_camera, crossings.crossing_type, quarters, _SAME_M), normals)
