"""Lines of every frame: searched everywhere at the start, now and then and on doubt; else near the last frame's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Features
from ceilvo.daemon.vision.crossings import VAGUE_RAD, Crosser
from ceilvo.daemon.vision.edge_tracking import EdgeTracker, predicted
from ceilvo.daemon.vision.edges import EdgeDetector
from ceilvo.daemon.vision.faint.level_picture import STEEPEST_DEG
from ceilvo.daemon.vision.faint.stage import FaintLines, FaintState
from ceilvo.daemon.vision.lens import for_lens
from ceilvo.daemon.vision.line_detection import LastFit, cost_px2, detect
from ceilvo.daemon.vision.line_pairing import EdgeSet
from ceilvo.daemon.vision.rolling_shutter import Readout, RollingShutter, TwistPrior
from ceilvo.daemon.vision.tilt_prior import TiltPrior, TiltState, TiltTracker
from ceilvo.types import Array, Lines

_NOISE_GROWTH = 1.01
"""Per frame, of the least noise seen: forgotten within some 100 frames; chosen: light and blur change."""
_TURNED_RAD = np.radians(0.3)
"""A direction this far from where the last frame's should be may be another optimum; chosen: motions are predicted
better, and seams of a hall that are not quite parallel have optima 0.7 deg apart."""
_FIRST_LOOKS = 3
"""Whole looks at the start in which a ceiling that slopes is looked for where a level one shows little; chosen."""
_LEANS_RAD = np.radians([[0.0, 5.0], [5.0, 0.0], [0.0, -5.0], [-5.0, 0.0]])
"""Tilts that are tried then; chosen: lines are found from 2 deg off."""
_VAGUE_TILT_RAD = np.radians(0.1)
"""A tilt known worse is none; chosen, as in line_fit.py."""
_SKEWED_PX = 0.2
"""Rows that are read one after the other are not moved to one instant for faint lines where that is less; chosen: a
tenth of a joint's width, and the picture is smoothed by it."""
_CLEARLY = 0.5
"""Ratio of the errors of two directions, from which it is plain which one is right; chosen: noise alone, from frame to
frame, makes that of two optima of the same lines 0.7 to 1.4."""


@dataclass(slots=True)
class LineFinderState:
    """What the last frames left for the next one.

    Attributes:
        tilt: of the robot, over many frames.
        edges: of the last frame, None when it showed no lines, or faint ones too.
        psi_rad: direction of the last frame's lines, in [-pi/4, pi/4); None when it showed none.
        tilt_rad: (2,) of the last frame that showed lines.
        best_noise_px: standard deviation of edge points about their lines in the cleanest of the latest frames.
        detection_noise_px: the same in the last frame that was searched whole.
        since_detection: frames since then.
        detections, tracked: frames that were searched whole, and near the predicted edges only.
        faint: what the last looks for faint lines showed.
        several: the ceiling was found to have several heights.
        points: frames in which points are still looked for, for there were too few lines.
    """

    tilt: TiltState = field(default_factory=TiltState)
    edges: EdgeSet | None = None
    tilt_rad: Array = field(default_factory=lambda: np.zeros(2))
    best_noise_px: float = np.inf
    detection_noise_px: float = 0.0
    since_detection: int = 0
    detections: int = 0
    tracked: int = 0
    faint: FaintState = field(default_factory=FaintState)
    psi_rad: float | None = None
    several: bool = False
    points: int = 0


class LineFinder:
    """Lines of every frame of one camera, with the memory of the last one.

    Attributes:
        config: the settings for this camera's lens.
        crossed: gives crossings of lines.
        readout: how the last frame was read, None with a global shutter.
    """

    def __init__(self, calibration: Calibration, config: Features) -> None:
        self.config = config = for_lens(config, calibration.level_view)
        self._calibration = calibration
        self._detector = EdgeDetector(calibration, config)
        self._shutter = RollingShutter(calibration, config.max_view_deg)
        self.crossed = Crosser(calibration, config)
        steepest_deg = min(config.max_view_deg, STEEPEST_DEG)
        self._reach_px = calibration.level_view.focal_px * float(np.tan(np.radians(steepest_deg)))
        self._faint = FaintLines(calibration, config, self.crossed) if config.faint_lines else None
        self._tracker = EdgeTracker(calibration, config) if config.full_every > 1 else None
        self.state = LineFinderState()
        self.readout: Readout | None = None

    @property
    def rolls(self) -> bool:
        """Whether rows are read one after the other."""
        return self._shutter.rolls

    def __call__(
        self,
        gray: NDArray[np.uint8],
        prev_from_curr: Array | None,
        on_stage_done: Callable[[str], None] = lambda stage: None,
        twist: TwistPrior | None = None,
        several: bool = False,
    ) -> Lines | None:
        """Lines of a frame, None when too few edge points agree on a direction.

        Args:
            gray: (H, W) of the calibrated size.
            prev_from_curr: (3,) predicted motion since the last frame; None when there is no good prediction.
            on_stage_done: called with "edges" and "lines" when these stages have ended.
            twist: predicted of the robot while the frame is read, for a rolling shutter; None when nothing is known.
            several: the ceiling has several heights; tilts seen before that was known are forgotten.
        """
        if several and not self.state.several:
            self.state.tilt, self.state.several = TiltState(), True
        s, tilt = self.state, TiltTracker(self.state.tilt)
        s.faint.since_look += 1
        readout = self.readout = self._shutter.readout(twist)
        prior = tilt.prior()
        found = self._track(gray, prev_from_curr, prior, readout)
        lines: Lines | None
        if found is not None:
            s.since_detection += 1
            s.tracked += 1
            lines, s.edges = found
        else:
            last_rad = s.psi_rad if s.edges is None else s.edges.psi_rad
            carried = None if last_rad is None or prev_from_curr is None else last_rad - float(prev_from_curr[2])
            lines = self._searched(gray, prior, readout, on_stage_done, carried)
        on_stage_done("lines")
        s.psi_rad = None if lines is None else lines.psi_rad
        if lines is None:
            return None
        s.tilt_rad = lines.tilt_rad
        if s.edges is not None:
            s.best_noise_px = min(s.edges.noise_px, s.best_noise_px * _NOISE_GROWTH)
            if s.since_detection == 0:
                s.detection_noise_px = s.edges.noise_px
        if s.faint.helps:
            s.edges = None
        tilt.update(lines)
        return lines

    def tilt_prior(self) -> TiltPrior | None:
        """How the robot has tilted lately; None where too few lines have shown it."""
        return TiltTracker(self.state.tilt).prior()

    def _searched(
        self,
        gray: NDArray[np.uint8],
        prior: TiltPrior | None,
        readout: Readout | None,
        on_stage_done: Callable[[str], None],
        carried_rad: float | None,
    ) -> Lines | None:
        """Lines of the whole frame.

        Args:
            carried_rad: direction of the last frame's lines as this one should show it; None where it is not known.
        """
        s = self.state
        s.since_detection = 0
        s.detections += 1
        edges = self._detector(gray, readout)
        on_stage_done("edges")
        focal_px = self._calibration.level_view.focal_px
        last = LastFit(s.tilt_rad, s.best_noise_px, s.several, TiltTracker(s.tilt).lately(beyond_noise=False))

        def along(psi_rad: float | None, last: LastFit = last) -> Lines | None:
            found = detect(edges, self.config, focal_px, prior, last, readout, psi_rad, carried_rad)
            lines, s.edges = (None, None) if found is None else found
            return lines

        lines = along(None)
        if s.detections <= _FIRST_LOOKS and (lines is None or _is_vague(lines)):
            as_level, misfit_px2 = (lines, s.edges), _misfit_px2(lines, s.edges, len(edges.uv_px))
            for lean in _LEANS_RAD:
                lines = along(None, LastFit(lean, s.best_noise_px))
                # rings of vents side by side are lines under 4 deg, too, but then some are left over
                fits = _misfit_px2(lines, s.edges, len(edges.uv_px)) <= misfit_px2
                if lines is not None and fits and _slopes(lines):
                    break
            else:
                lines, s.edges = as_level
        if carried_rad is not None and (lines is None or _is_doubtful(lines, carried_rad)):
            free, edges_of_it = lines, s.edges
            lines = along(carried_rad)
            if lines is None or (free is not None and _stays(free, lines)):
                lines, s.edges = free, edges_of_it
        if self._faint is None:
            return lines
        skewed = readout if readout is not None and readout.skew_px(self._reach_px) > _SKEWED_PX else None
        return self._faint(
            gray, lines, along, s.faint, s.tilt_rad, prior, skewed, TiltTracker(s.tilt).lately(beyond_noise=True)
        )

    def _track(
        self, gray: NDArray[np.uint8], prev_from_curr: Array | None, prior: TiltPrior | None, readout: Readout | None
    ) -> tuple[Lines, EdgeSet] | None:
        s = self.state
        if self._tracker is None or s.edges is None or prev_from_curr is None or prior is None:
            return None
        if s.since_detection + 1 >= self.config.full_every:
            return None
        expected = predicted(s.edges, prev_from_curr, self._calibration)
        # what a full look could not fit better, a close one need not
        last = LastFit(s.tilt_rad, max(s.best_noise_px, s.detection_noise_px))
        return self._tracker(gray, expected, last, prior, readout)


def _is_doubtful(lines: Lines, carried_rad: float) -> bool:
    """Whether lines along the last frame's direction may be the better ones: these tell theirs badly, or another."""
    return bool(lines.psi_sigma_rad > VAGUE_RAD or _apart(lines.psi_rad, carried_rad) > _TURNED_RAD)


def _is_vague(lines: Lines) -> bool:
    """Whether the lines of a frame leave its tilt open."""
    return bool(np.max(lines.free_tilt_sigma_rad) > _VAGUE_TILT_RAD)


def _slopes(lines: Lines) -> bool:
    """Whether lines tell a tilt, that no robot has."""
    return not _is_vague(lines) and LastFit(lines.tilt_rad, 0.0).leans


def _misfit_px2(lines: Lines | None, edges: EdgeSet | None, points: int) -> float:
    """How badly lines fit so many points that they were looked for among."""
    if lines is None or edges is None:
        return np.inf
    return cost_px2(int(np.sum(lines.support)), edges.noise_px, points)


def _stays(free: Lines, carried: Lines) -> bool:
    """Whether lines that were found freely are kept over those found along the last frame's direction: of one direction
    unless those know it far better, of another where these know theirs far better."""
    if _apart(free.psi_rad, carried.psi_rad) < _TURNED_RAD:
        return bool(carried.psi_sigma_rad >= _CLEARLY * free.psi_sigma_rad)
    return bool(free.psi_sigma_rad < _CLEARLY * carried.psi_sigma_rad)


def _apart(psi_rad: float, other_rad: float) -> float:
    """Angle between two directions, modulo a quarter turn."""
    return float(abs((psi_rad - other_rad + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi))
