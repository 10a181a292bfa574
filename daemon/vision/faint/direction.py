"""The direction that faint lines share, where edge points do not tell it: the spectrum of a small picture does.

By the projection theorem the power along a ray of the spectrum is that of the picture's sums along all lines across
that ray, so parallel lines stand out there together, however faint each of their pixels is.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.vision.line_pairing import fold_direction
from ceilvo.robust import MAD_TO_SIGMA, median
from ceilvo.types import Array

Gray = NDArray[np.uint8]
Array32 = NDArray[np.float32]

_SMALL_PX = 200
"""Longer side of the small picture; chosen: a line across it tells its direction to a third of a degree."""
_SPECTRUM_PX = 256
"""Side of the spectrum: the next power of two."""
_NARROW_PX, _WIDE_PX = 0.7, 2.5
"""Standard deviations of the two Gaussians whose difference answers to ridges; chosen."""
_RIM_PX = 3
"""Of what is unknown, around which answers are not used; chosen: a standard deviation of the wide one."""
_NEXT = np.ones((3, 3), np.uint8)
_CLIP_SIGMAS = 2.5
"""Of an answer; chosen: as in voting.py."""
_LOWEST, _HIGHEST = 16.0, 110.0
"""Frequencies that are looked at, cycles in _SPECTRUM_PX: below, one is several degrees wide; above, only noise."""
_BINS = 90
"""Of a quarter turn: a degree each."""
_FEWEST_PX = 400
"""Pixels that are known; chosen: a hundredth of the small picture."""
_LEAST_NOISE = 0.02
"""Grey levels of an answer; chosen: whole numbers, a dozen of which are one small pixel, are no finer."""
_LEAST_WEIGHT = 1e-3
"""Of what is known around a pixel, so that nothing is divided by 0."""
_TRUSTED = 6.0
"""Power of a direction over the usual, in standard deviations of what directions have; chosen: pure noise and round
lamps stay below (tests/daemon/vision/faint/test_direction.py)."""


def common_direction(level: Gray, usable: Gray) -> float | None:
    """Direction in [-pi/4, pi/4) of the normals of most faint ridges modulo 90 deg; None where none stands out.

    Args:
        level, usable: (H, W) a level view, and 255 where it shows the ceiling.
    """
    answer = _ridges(level, usable)
    if answer is None:
        return None
    spectrum = cv2.dft(
        cv2.copyMakeBorder(
            answer, 0, _SPECTRUM_PX - len(answer), 0, _SPECTRUM_PX - answer.shape[1], cv2.BORDER_CONSTANT
        ),
        flags=cv2.DFT_COMPLEX_OUTPUT,
    )
    power = spectrum[..., 0] ** 2 + spectrum[..., 1] ** 2
    which, cell, weight = _rays()
    votes = np.bincount(cell, power.reshape(-1)[which] * weight, _BINS)
    three = votes + np.roll(votes, 1) + np.roll(votes, -1)
    usual = float(np.median(three))
    spread = MAD_TO_SIGMA * median(np.abs(three - usual))
    best = int(np.argmax(three))
    if three[best] < usual + _TRUSTED * spread:
        return None
    beside = votes[[best - 1, (best + 1) % _BINS]] - usual / 3.0
    middle = (beside[1] - beside[0]) / max(three[best] - usual, 1e-9)
    return fold_direction(float((best + middle) * 0.5 * np.pi / _BINS))[0]


def _ridges(level: Gray, usable: Gray) -> Array32 | None:
    """The small picture's clipped answers, 0 where nothing is known; None where hardly anything is."""
    shrink = max(max(level.shape) / _SMALL_PX, 1.0)
    size = round(level.shape[1] / shrink), round(level.shape[0] / shrink)
    # eroded, for a small pixel that is known but for a thousandth is rounded to one that is known
    known = np.asarray(cv2.resize(usable, size, interpolation=cv2.INTER_AREA)) == 255
    whole = np.asarray(cv2.erode(known.astype(np.uint8), _NEXT), np.float32)
    small = cv2.resize(level, size, interpolation=cv2.INTER_AREA).astype(np.float32) * whole
    answer = _smooth(small, whole, _WIDE_PX) - _smooth(small, whole, _NARROW_PX)
    inner = cv2.erode(whole, np.ones((2 * _RIM_PX + 1,) * 2, np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    values = np.asarray(answer[inner > 0], np.float32)
    if len(values) < _FEWEST_PX or float(np.abs(values).max()) < _LEAST_NOISE:
        return None
    noise = max(MAD_TO_SIGMA * median(np.abs(values)), _LEAST_NOISE)
    return np.asarray(np.clip(answer / noise, -_CLIP_SIGMAS, _CLIP_SIGMAS) * inner, np.float32)


def _smooth(picture: Array32, weight: Array32, sigma_px: float) -> Array32:
    """Means that take in only what is known."""
    total, of = (cv2.GaussianBlur(v, (0, 0), sigma_px) for v in (picture, weight))
    return np.asarray(total / np.maximum(of, _LEAST_WEIGHT), np.float32)


@cache
def _rays() -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Frequencies that are looked at, the direction of each modulo 90 deg as a bin, and its part of the bin's ray."""
    f = np.fft.fftfreq(_SPECTRUM_PX, 1.0 / _SPECTRUM_PX)
    fx, fy = np.meshgrid(f, f)
    radius = np.hypot(fx, fy).reshape(-1)
    which = np.flatnonzero((radius > _LOWEST) & (radius < _HIGHEST))
    angle = np.mod(np.arctan2(fy, fx).reshape(-1)[which], 0.5 * np.pi)
    cell = np.rint(angle * _BINS / (0.5 * np.pi)).astype(np.int64) % _BINS
    weight = 1.0 / np.bincount(cell, minlength=_BINS)[cell]
    return which, cell, weight
