"""Lamps in a picture, as raw pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.daemon.vision.points.lamps import find_lamps
from ceilvo.daemon.vision.points.places import Places, denoised
from ceilvo.senses.beacons import LampSeen


class LampFinder:
    """Of one camera; the same picture gives the same lamps."""

    def __init__(self, calibration: Calibration, max_view_deg: float) -> None:
        self._places = Places(calibration, max_view_deg)

    def __call__(self, gray: NDArray[np.uint8]) -> tuple[LampSeen, ...]:
        """The bright blobs in a raw picture (H, W), from left to right."""
        view = self._places.view
        looked_at = view.reduced(gray)
        found, _ = find_lamps(looked_at, denoised(looked_at), self._places)
        at = view.to_raw(found.uv + np.array([view.camera.cx_px, view.camera.cy_px]))
        return tuple(LampSeen(one) for one in at[np.argsort(at[:, 0], kind="stable")])
