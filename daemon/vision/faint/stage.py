"""When faint lines are looked for, and what becomes of a frame's lines then.

A look at faint lines costs twice as much as one at the whole frame, so it is taken where edge points give few
crossings, and now and then where they give enough. It goes on frame after frame while it finds clearly more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Features
from ceilvo.daemon.vision.crossings import Crosser, squares_with
from ceilvo.daemon.vision.faint.direction import common_direction
from ceilvo.daemon.vision.faint.level_picture import LevelPicture
from ceilvo.daemon.vision.faint.line_search import find_faint
from ceilvo.daemon.vision.faint.merging import folded, merged
from ceilvo.daemon.vision.rolling_shutter import Readout
from ceilvo.daemon.vision.tilt_prior import NOTHING_LATELY, Lately, TiltPrior
from ceilvo.types import Array, Lines

_FEW = 10
"""Places with crossings of edge points below which faint lines are looked for soon; chosen: tiles show 30."""
_WEAK = 5
"""Below so many the direction of the edge points is not trusted either; chosen."""
_PROBE_FRAMES, _RETRY_FRAMES = 300, 6
"""Between looks that did not help: 10 s at 30 Hz where edge points do, a fifth of a second where they do not; chosen: a
look costs some three frames, so 1 % of the time where it is not needed."""
_FIRST_FRAMES = 3
"""The first look where edge points do; chosen: before the first good pose, for what is seen changes when it helps, and
not at the first frame: a robot that starts had its first pose .15 s later."""
_OF_TILES = 42
"""Places taken for those of a look before the first one, so that this is taken at once below 25; measured: tiles of
.6 m show 32 to 48, faint ones 14 to 20."""
_FEWER = 0.6
"""Places over those at the last look, below which it is not waited for so long; chosen: other ground."""
_MORE, _STILL_MORE = 1.25, 1.1
"""Places with faint lines over those without, for looks to begin and to go on; chosen apart, so that they do not
begin and end from frame to frame."""
_MORE_AT_LEAST = 2
"""Places; chosen: few frames have exactly as many as the one before."""


@dataclass(slots=True)
class FaintState:
    """What the last looks showed.

    Attributes:
        helps: the last look found clearly more than edge points did; all frames are looked at so.
        since_look: frames since the last look.
        places: with crossings of edge points, in the frame of the last look.
    """

    helps: bool = False
    places: int = _OF_TILES
    since_look: int = _PROBE_FRAMES - _FIRST_FRAMES


class FaintLines:
    """Faint lines of the frames of one camera; its look-up is made at the first look."""

    def __init__(self, calibration: Calibration, config: Features, crossed: Crosser) -> None:
        """crossed: gives crossings of lines."""
        self._calibration, self._config, self._crossed = calibration, config, crossed
        self._picture: LevelPicture | None = None

    def __call__(
        self,
        gray: NDArray[np.uint8],
        found: Lines | None,
        again: Callable[[float | None], Lines | None],
        state: FaintState,
        tilt_rad: Array,
        prior: TiltPrior | None,
        readout: Readout | None = None,
        lately: Lately = NOTHING_LATELY,
    ) -> Lines | None:
        """Lines of a frame that was searched whole, with faint ones where they help; state says whether they did.

        Args:
            gray: (H, W) of the calibrated size.
            found: its lines by edge points.
            again: gives those along a direction, rad.
            tilt_rad: (2,) of the last frame.
            prior: of the tilt.
            readout: of a rolling shutter.
            lately: tilts, see TiltTracker.
        """
        edge_places = self._places(found)
        few = edge_places < max(_FEW, _FEWER * state.places)
        wait = 1 if state.helps else _RETRY_FRAMES if few else _PROBE_FRAMES
        if state.since_look < wait:
            return found
        state.since_look, state.places = 0, edge_places
        both = self._look(gray, found, edge_places < _WEAK, again, tilt_rad, prior, readout, lately)
        factor = _STILL_MORE if state.helps else _MORE
        need = max(factor * edge_places, edge_places + _MORE_AT_LEAST)
        state.helps = self._places(both) >= need
        return both if state.helps else found

    def _places(self, lines: Lines | None) -> int:
        if lines is None:
            return 0
        return squares_with(self._crossed(lines), self._calibration.level_view.focal_px)

    def _look(
        self,
        gray: NDArray[np.uint8],
        found: Lines | None,
        weak: bool,
        again: Callable[[float | None], Lines | None],
        tilt_rad: Array,
        prior: TiltPrior | None,
        readout: Readout | None,
        lately: Lately,
    ) -> Lines | None:
        if self._picture is None:
            self._picture = LevelPicture(self._calibration, self._config.max_view_deg)
        level, usable = self._picture(gray, readout)
        psi = None if found is None else found.psi_rad
        if weak:
            common = common_direction(level, usable)
            psi = psi if common is None else common
        if psi is None:
            return found
        known_rad = None
        if found is not None and not weak:
            tilt_rad, known_rad = found.tilt_rad, float(np.max(found.tilt_sigma_rad))
        faint = find_faint(self._picture, level, usable, psi, tilt_rad, self._config, prior, known_rad, lately)
        if faint is None:
            return found
        if weak:
            found = again(faint.psi_rad)
        if found is None:
            return folded(faint)
        return merged(found, faint, self._picture.focal_px, self._config.groove_deg)
