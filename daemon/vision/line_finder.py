"""Which way to find lines: everywhere at the start, now and then and on doubt; else where the last frame says."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Features
from ceilvo.daemon.vision.edge_tracking import BandDetector, predicted
from ceilvo.daemon.vision.edges import EdgeDetector
from ceilvo.daemon.vision.line_detection import LastFit, detect
from ceilvo.daemon.vision.line_pairing import EdgeSet
from ceilvo.daemon.vision.tilt_prior import TiltTracker
from ceilvo.types import Array, Lines

_CLEAN_FADES = 1.01


class LineFinder:
    """Lines of every frame of one camera, with the memory of the last one."""

    def __init__(self, calibration: Calibration, config: Features) -> None:
        self._calibration, self._config = calibration, config
        self._edges = EdgeDetector(calibration, config)
        self._bands = BandDetector(calibration, config) if config.full_every > 1 else None
        self.reset()

    def reset(self) -> None:
        """Forget the last frame."""
        self._tilt = TiltTracker()
        self._last: EdgeSet | None = None
        self._last_tilt = np.zeros(2)
        self._clean_px = np.inf
        self._full_px = 0.0
        self._since_full = 0
        self.full = 0
        self.verified = 0

    def __call__(
        self, gray: NDArray[np.uint8], prev_from_curr: Array | None, lap: Callable[[str], None] = lambda stage: None
    ) -> Lines | None:
        """Lines of a frame.

        Args:
            prev_from_curr: (3,) predicted motion since the last frame; None when there is no good prediction.
            lap: called with "edges" and "lines" when these stages have ended.
        """
        found = self._verify(gray, prev_from_curr)
        if found is None:
            self._since_full = 0
            self.full += 1
            edges = self._edges(gray)
            lap("edges")
            focal_px = self._calibration.level_view.focal_px
            found = detect(edges, self._config, focal_px, self._tilt.prior(), LastFit(self._last_tilt, self._clean_px))
        else:
            self._since_full += 1
            self.verified += 1
        lap("lines")
        if found is None:
            self._last = None
            return None
        lines, self._last = found
        self._last_tilt = lines.tilt_rad
        self._clean_px = min(self._last.noise_px, self._clean_px * _CLEAN_FADES)
        if self._since_full == 0:
            self._full_px = self._last.noise_px
        self._tilt.note(lines)
        return lines

    def _verify(self, gray: NDArray[np.uint8], prev_from_curr: Array | None) -> tuple[Lines, EdgeSet] | None:
        prior = self._tilt.prior()
        if self._bands is None or self._last is None or prev_from_curr is None or prior is None:
            return None
        if self._since_full + 1 >= self._config.full_every:
            return None
        expected = predicted(self._last, prev_from_curr, self._calibration)
        # what a full look could not fit better, a close one need not
        last = LastFit(self._last_tilt, max(self._clean_px, self._full_px))
        return self._bands(gray, expected, last, prior)
