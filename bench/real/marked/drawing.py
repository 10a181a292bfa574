"""A picture with its marks and what was found: found, missed, spurious and apart in colours of their own."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.bench.real.marked.judging import TRUE_SHARE, Judged, mark_piece
from ceilvo.bench.real.marked.reading import Marked
from ceilvo.daemon.replay.drawing.overlay import GREEN, GREY, SKY, VERMILION, YELLOW, Colour, line_in_raw
from ceilvo.types import Array, Lines

_SHIFT = 4
"""Bits of a pixel's fraction that cv2 draws with."""
_WIDE_PX = 800
"""Pictures are reduced or enlarged to about this; chosen: lines 1 px wide show."""


def drawn(
    gray: NDArray[np.uint8], lines: Lines, judged: Judged, marked: Marked, max_view_deg: float
) -> NDArray[np.uint8]:
    """(h, w, 3) BGR: marks yellow where found and vermilion where missed, under the found lines: green where they lie
    on marks, blue where nobody marked any, grey apart."""
    scale = max(round(_WIDE_PX / gray.shape[1] * 4) / 4, 0.25)
    size = round(gray.shape[1] * scale), round(gray.shape[0] * scale)
    image = np.asarray(0.6 * cv2.cvtColor(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR))
    picture = np.asarray(image, np.uint8)
    view = marked.calibration.level_view
    for ends, found in zip(marked.ends, judged.found, strict=True):
        piece = mark_piece(ends, marked.calibration, max_view_deg)
        _curve(picture, view.whole_px(piece.at), scale, YELLOW if found >= TRUE_SHARE else VERMILION, 3)
    for k in range(len(lines.axis)):
        colour = GREEN if judged.true[k] else SKY if judged.spurious[k] else GREY
        _curve(picture, line_in_raw(lines, k, view), scale, colour, 1)
    _curve(picture, np.vstack([marked.ceiling, marked.ceiling[:1]]), scale, GREY, 1)
    return picture


def _curve(picture: NDArray[np.uint8], raw: Array, scale: float, colour: Colour, wide: int) -> None:
    at = (raw + 0.5) * scale - 0.5
    far = 4.0 * max(picture.shape)
    good = np.all(np.isfinite(at) & (np.abs(np.nan_to_num(at)) < far), axis=1)
    for run in np.split(np.arange(len(at)), np.flatnonzero(np.diff(good)) + 1):
        if len(run) > 1 and good[run[0]]:
            points = np.rint(at[run] * (1 << _SHIFT)).astype(np.int32).reshape(-1, 1, 2)
            cv2.polylines(picture, [points], False, colour, wide, cv2.LINE_AA, _SHIFT)
