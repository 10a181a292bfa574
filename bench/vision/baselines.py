"""Two textbook ways to get the same motion, for comparison on the same frames: tracked points and matched descriptors.

Both: pixels -> level view -> ceiling in base -> RANSAC -> rigid fit. They know the lens and the mounting, not the tilt.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration, to_ceiling
from ceilvo.daemon.odometry.rigid import rigid_motion

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

_POINTS = 200  # tracked at most; docs/bench.md (KLT)
_FEWEST = 150  # chosen: three quarters of _POINTS left, then new ones are looked for
_RANSAC_M = 0.01  # on the ceiling; chosen: about 2 px at the simulator's height


class Baseline(Protocol):
    """prev_from_curr (3,) of each frame; the last motion where there is none."""

    def step(self, gray: Gray) -> Array: ...


class PointTracker:
    """Shi-Tomasi corners followed with pyramidal Lucas-Kanade."""

    def __init__(self, calibration: Calibration) -> None:
        self._ground = _Ground(calibration)
        self._prev: Gray | None = None
        self._points = np.zeros((0, 1, 2), np.float32)
        self._motion = np.zeros(3)

    def step(self, gray: Gray) -> Array:
        if self._prev is not None and len(self._points):
            moved, status, _ = cv2.calcOpticalFlowPyrLK(
                self._prev, gray, self._points, np.empty_like(self._points), winSize=(21, 21), maxLevel=3
            )
            ok = status.reshape(-1) == 1
            before, after = self._points.reshape(-1, 2)[ok], np.asarray(moved).reshape(-1, 2)[ok]
            self._motion, inliers = self._ground.motion(after, before, self._motion)
            self._points = np.ascontiguousarray(after[inliers].reshape(-1, 1, 2), np.float32)
        if len(self._points) < _FEWEST:
            corners: Any = cv2.goodFeaturesToTrack(gray, _POINTS, 0.01, 10)
            self._points = np.zeros((0, 1, 2), np.float32) if corners is None else corners.reshape(-1, 1, 2)
        self._prev = gray
        return self._motion


class DescriptorMatcher:
    """ORB with cross-checked brute-force matching."""

    def __init__(self, calibration: Calibration) -> None:
        self._ground = _Ground(calibration)
        self._orb: Any = cv2.ORB_create(nfeatures=500)  # type: ignore[attr-defined]
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        self._prev: tuple[Array, Any] | None = None
        self._motion = np.zeros(3)

    def step(self, gray: Gray) -> Array:
        keys, descriptors = self._orb.detectAndCompute(gray, None)
        points = np.array([k.pt for k in keys], np.float64).reshape(-1, 2)
        if self._prev is not None and descriptors is not None and self._prev[1] is not None:
            pairs = self._matcher.match(descriptors, self._prev[1])
            now, then = [p.queryIdx for p in pairs], [p.trainIdx for p in pairs]
            self._motion, _ = self._ground.motion(points[now], self._prev[0][then], self._motion)
        self._prev = points, descriptors
        return self._motion


class _Ground:
    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._centre = np.array([calibration.camera.cx_px, calibration.camera.cy_px])
        self._lookup = replace(calibration.level_view, reduction=1).lookup(70.0)

    def motion(self, curr_px: Array, prev_px: Array, otherwise: Array) -> tuple[Array, NDArray[np.bool_]]:
        """prev_from_curr (3,) and which points agree with it; `otherwise` when too few do."""
        if not len(curr_px):
            return otherwise, np.zeros(0, bool)
        curr, prev = self._on_ceiling(curr_px), self._on_ceiling(prev_px)
        at = np.flatnonzero(np.isfinite(curr).all(axis=1) & np.isfinite(prev).all(axis=1))
        agree = np.zeros(len(curr), bool)
        if len(at) < 4:
            return otherwise, agree
        _, used = cv2.estimateAffinePartial2D(
            curr[at], prev[at], method=cv2.RANSAC, ransacReprojThreshold=_RANSAC_M, refineIters=0
        )
        if used is None or int(used.sum()) < 4:
            return otherwise, agree
        agree[at[used.reshape(-1) == 1]] = True
        return rigid_motion(curr[agree], prev[agree]), agree

    def _on_ceiling(self, uv_px: Array) -> Array:
        """(N, 2) m for (N, 2) raw pixels, by linear interpolation in the look-up."""
        at = np.asarray(uv_px, np.float32).reshape(-1, 1, 2)
        none: Any = None
        level = cv2.remap(self._lookup, at, none, cv2.INTER_LINEAR, borderValue=(np.nan,) * 4)
        return to_ceiling(self._calibration.ceiling_from_level, level.reshape(-1, 2) + self._centre)
