"""Stages 1 to 3 in one: from a frame to the crossings in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ceilvo.calibration import Calibration
from ceilvo.config import Features
from ceilvo.daemon.vision.finder.line_finder import LineFinder, LineFinderState
from ceilvo.daemon.vision.points.stage import PointFinder
from ceilvo.daemon.vision.rolling_shutter import TwistPrior
from ceilvo.daemon.vision.thinning import thinned
from ceilvo.types import Array, Crossings, Frame, Ints, Lines

_SAMPLES_A_SIDE = 32
"""Of the picture's sample; chosen: 1024 grey levels tell noise from none, and are a fifth of what crossings take."""

OnStageDone = Callable[[str], None]
"""Called with a stage's name when it has ended; the caller owns the clock."""


def ignore(stage: str) -> None:
    """For callers that do not time the stages."""


@dataclass(frozen=True, slots=True)
class View:
    """What a frame looked like, for pictures."""

    frame: Frame
    lines: Lines | None
    crossings: Crossings | None


class CrossingFinder:
    """Canny -> Hough -> least squares -> crossings."""

    def __init__(self, calibration: Calibration, config: Features) -> None:
        self._calibration = calibration
        self._lines = LineFinder(calibration, config)
        self._points = PointFinder(calibration, config.max_view_deg) if config.points else None
        self._raster = _raster(calibration.camera.height_px, calibration.camera.width_px)
        self.view: View | None = None

    @property
    def state(self) -> LineFinderState:
        return self._lines.state

    @state.setter
    def state(self, state: LineFinderState) -> None:
        self._lines.state = state

    @property
    def rolls(self) -> bool:
        """Whether the camera's rows are read one after the other, so that the robot's twist matters."""
        return self._lines.rolls

    def __call__(
        self,
        frame: Frame,
        expected: Array | None,
        on_stage_done: OnStageDone = ignore,
        twist: TwistPrior | None = None,
        several: bool = False,
        flickers: bool = False,
        fixtures: bool = False,
    ) -> Crossings | None:
        """Crossings of a frame, and points where these are few; None without either.

        Args:
            expected: (3,) predicted motion since the last frame.
            twist: predicted while the frame is read, for a rolling shutter.
            several: the ceiling has several heights.
            flickers: crossings come and go, so points are looked for in any case.
            fixtures: corners and spots are to be looked for besides.
        """
        lines = self._lines(frame.gray, expected, on_stage_done, twist, several)
        crossings = None if lines is None else self._lines.crossed(lines)
        if crossings is not None:
            crossings = thinned(crossings, self._calibration.level_view.focal_px)
        if self._points is not None:
            state, prior = self.state, self._lines.tilt_prior()
            crossings, state.points = self._points(
                frame.gray, crossings, prior, state.since_detection == 0, state.points, self._lines.readout, flickers
            )
            if fixtures and crossings is not None:
                seen = self._points.fixtures(frame.gray, crossings, self._lines.readout)
                crossings = replace(crossings, fixtures_m=seen)
        if crossings is not None:
            crossings = replace(crossings, sample_gray=frame.gray.take(self._raster))
        on_stage_done("crossings")
        self.view = View(frame, lines, crossings)
        return crossings


def _raster(height: int, width: int) -> Ints:
    """(_SAMPLES_A_SIDE^2,) pixels of an even raster, counted row after row."""
    rows, columns = (np.linspace(0, n - 1, _SAMPLES_A_SIDE + 2)[1:-1].astype(np.int64) for n in (height, width))
    return np.add.outer(width * rows, columns).ravel()
