"""Tags in a picture, by OpenCV's detector."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.senses.beacons import MarkSeen

_FAMILIES = {
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "aruco_4x4": cv2.aruco.DICT_4X4_1000,
    "aruco_5x5": cv2.aruco.DICT_5X5_1000,
    "aruco_6x6": cv2.aruco.DICT_6X6_1000,
}
_WINDOWS_PX = (7, 27, 20)
"""Smallest and largest window of the adaptive threshold, and its steps; OpenCV's own three cost half as much again."""


_REFINED_PX, _REFINED_CELLS = 5, 1.0
"""Half the window that a corner is refined in: so many pixels, and no more than so many of the tag's own cells. With
OpenCV's 0.3 cells corners of tags of 40 px were off by 0.41 px, with these by 0.15; its AprilTag refinement is as good
and takes 120 ms (40 drawn pictures, 640 x 480)."""


class MarkFinder:
    """Of one family; only the numbers that are known are told. The same picture gives the same marks."""

    def __init__(self, family: str, numbers: frozenset[int]) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.cornerRefinementWinSize, parameters.relativeCornerRefinmentWinSize = _REFINED_PX, _REFINED_CELLS
        low, high, step = _WINDOWS_PX
        parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = low, high
        parameters.adaptiveThreshWinSizeStep = step
        self._detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(_FAMILIES[family]), parameters)
        self._numbers = numbers

    def __call__(self, gray: NDArray[np.uint8]) -> tuple[MarkSeen, ...]:
        """The marks in a raw picture (H, W), by number."""
        corners, ids, _ = self._detector.detectMarkers(gray)
        if not len(corners):  # ids is None then
            return ()
        found = zip(np.ravel(ids).tolist(), corners, strict=True)
        known = [(n, np.asarray(c, np.float64).reshape(4, 2)) for n, c in found if n in self._numbers]
        alone = [(n, c) for n, c in known if sum(n == other for other, _ in known) == 1]
        return tuple(MarkSeen(n, c) for n, c in sorted(alone, key=lambda one: one[0]))
