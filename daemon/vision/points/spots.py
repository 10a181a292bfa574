"""Spots and corners: what stands out of the ceiling in all directions, at the scale at which it does most."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CORNER, SPOT
from ceilvo.daemon.vision.points.places import NONE, Found, Gray, Places
from ceilvo.robust import MAD_TO_SIGMA
from ceilvo.types import Array, Ints

Floats = NDArray[np.float32]

_OCTAVES = 3
"""Halvings of the picture in which spots are looked for: radii of about 6, 12 and 24 px; chosen: a sprinkler has 7 px
and a loudspeaker 20 px on a ceiling 2.2 m above a camera of 410 px."""
_INNER_PX, _OUTER_PX = 2.0, 3.2
"""Standard deviations of the two blurs, pixels of an octave; their ratio is Lowe's 1.6."""
_SIGMAS, _LEAST_LEVELS = 6.0, 1.0
"""How much a spot stands out: in standard deviations of the rest, and grey levels; chosen: noise never does."""
_ROUND = 0.3
"""Least ratio of the curvatures across a spot; chosen: below, it is a line's end or a piece of one."""
_APART = 5
"""Pixels of an octave around a spot in which it must stand out most."""
_SPOT_SIGMA_PX = 0.12
"""Error of a spot's middle, pixels of its octave; chosen above what rendered spots show."""
_AROUND_LAMPS_PX = 17
"""Side of the square around what is as bright as a lamp where nothing is looked for: its glow and its corners."""
_BORDER_PX = 8
_CORNER_QUALITY, CORNER_LEAST = 0.15, 2e-4
"""Of Shi and Tomasi (1994): the weakest corner, as a part of the strongest; and its eigenvalue, of a picture of 0 to 1
without noise; both chosen."""
CORNER_BLOCK, _CORNER_AROUND, _SUBPIX = 7, np.ones((15, 15), np.uint8), (5, 5)
_BAND_ROWS = 120
"""Rows of a picture that corners are looked for in at a time; chosen for memory."""
_SUBPIX_UNTIL = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
CORNER_LEVELS = 255.0 * np.sqrt(CORNER_LEAST)
"""Grey levels between the darkest and the brightest of a picture below which no corner is strong enough: none has an
eigenvalue above the square of that difference. So a black or white picture is not searched."""
_CORNER_SIGMA_PX, _CORNER_VAGUE_PX = 0.1, 0.006
"""Error of a corner, and what a weak one errs by besides, times the root of its eigenvalue; chosen above what rendered
joints and stains show."""
_CORNER_STANDS_OUT, _CORNER_BESIDE_PX = 8.0, 61
"""Times the usual eigenvalue in a square of that side; noise reached 7.3 times the mean in 180 pictures, and of others
within .5 % as many times the usual as the mean."""
_CORNER_CLIPPED = 4.0
"""Times the mean that an eigenvalue counts at most in what is usual; chosen."""
_MOST_SPOTS, _MOST_CORNERS = 30, 40
"""Chosen for time."""
_ALIKE = 2.0
"""Corners are alike that are no stronger than so many times the median; chosen."""


def free_of_lamps(places: Places, bright: Gray) -> Gray:
    """(H, W) 255 where spots and corners are looked for."""
    near = cv2.dilate(bright, np.ones((_AROUND_LAMPS_PX, _AROUND_LAMPS_PX), np.uint8))
    free = cv2.subtract(places.known, near)
    free[:_BORDER_PX], free[-_BORDER_PX:], free[:, :_BORDER_PX], free[:, -_BORDER_PX:] = 0, 0, 0, 0
    return np.asarray(free, np.uint8)


def find_spots(gray: Gray, places: Places, free: Gray) -> Found:
    """Round things darker or brighter than what is around them; the strongest of the scales at each place."""
    pixels, strength, sigma_px = np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    octave, usable = np.asarray(gray, np.float32), free
    for k in range(1, _OCTAVES + 1):
        octave = np.asarray(cv2.pyrDown(octave), np.float32)
        usable = np.asarray(cv2.erode(usable, np.ones((3, 3), np.uint8))[::2, ::2], np.uint8)
        at, strong = _extrema(octave, usable)
        size = float(2**k)
        pixels, strength = np.concatenate([pixels, at * size]), np.concatenate([strength, strong])
        sigma_px = np.concatenate([sigma_px, np.full(len(at), _SPOT_SIGMA_PX * size)])
    order = np.argsort(-strength, kind="stable")
    kept: list[int] = []
    for i in order.tolist():
        near = np.hypot(*(pixels[kept] - pixels[i]).T) if kept else np.full(1, np.inf)
        if np.min(near) > 2.0 * _APART:
            kept.append(i)
        if len(kept) == _MOST_SPOTS:
            break
    return places.found(pixels[kept], sigma_px[kept], SPOT) if kept else NONE


def _extrema(octave: Floats, usable: Gray) -> tuple[Array, Array]:
    """(N, 2) places in an octave that stand out in all directions, and (N,) by how many grey levels."""
    off = cv2.GaussianBlur(octave, (0, 0), _INNER_PX) - cv2.GaussianBlur(octave, (0, 0), _OUTER_PX)
    size = np.abs(off)
    seen = size[usable > 0]
    if len(seen) < _APART**2:
        return np.zeros((0, 2)), np.zeros(0)
    least = max(_SIGMAS * MAD_TO_SIGMA * float(np.median(seen)), _LEAST_LEVELS)
    around = np.ones((2 * _APART + 1, 2 * _APART + 1), np.uint8)
    row, column = _where((size >= least) & (size >= cv2.dilate(size, around)) & (usable > 0))
    inside = (row > 0) & (column > 0) & (row < off.shape[0] - 1) & (column < off.shape[1] - 1)
    row, column = row[inside], column[inside]
    f = np.asarray(off, np.float64)
    here, left, right = f[row, column], f[row, column - 1], f[row, column + 1]
    above, below = f[row - 1, column], f[row + 1, column]
    dx, dy, dxx, dyy = (
        0.5 * (right - left),
        0.5 * (below - above),
        right + left - 2.0 * here,
        below + above - 2.0 * here,
    )
    dxy = 0.25 * (f[row + 1, column + 1] + f[row - 1, column - 1] - f[row + 1, column - 1] - f[row - 1, column + 1])
    det, trace = dxx * dyy - dxy**2, dxx + dyy
    # the ratio of the curvatures is at least r where det / trace^2 is at least r / (1 + r)^2
    good = det > _ROUND / (1.0 + _ROUND) ** 2 * trace**2
    x, y = -(dyy * dx - dxy * dy)[good] / det[good], -(dxx * dy - dxy * dx)[good] / det[good]
    near = (np.abs(x) <= 1.0) & (np.abs(y) <= 1.0)
    at = np.column_stack([column[good] + x, row[good] + y])[near]
    return at, np.abs(here[good][near])


def _where(mask: NDArray[np.bool_]) -> tuple[Ints, Ints]:
    """Rows and columns that are set; np.nonzero() takes 1.2 ms of a picture, this .1."""
    row, column = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return row, column


def _eigenvalues(smooth: Gray) -> Floats:
    """(H, W) the lesser ones of Shi and Tomasi, band by band: the whole takes 6 MB meanwhile."""
    strong = np.empty(smooth.shape, np.float32)
    for k in range(0, len(smooth), _BAND_ROWS):
        first, last = max(k - CORNER_BLOCK, 0), min(k + _BAND_ROWS, len(smooth))
        band = cv2.cornerMinEigenVal(smooth[first : last + CORNER_BLOCK], CORNER_BLOCK)
        strong[k:last] = band[k - first : last - first]
    return strong


def _usual(strong: Floats) -> Floats:
    """(H, W) eigenvalues that are usual around each pixel, corners left out: of hexagons there are six in a square."""
    side = (_CORNER_BESIDE_PX, _CORNER_BESIDE_PX)
    mean = cv2.boxFilter(strong, -1, side)
    return np.asarray(cv2.boxFilter(np.minimum(strong, _CORNER_CLIPPED * mean), -1, side))


def _first(strength: Floats, pixels: Array, shape: tuple[int, ...]) -> Ints:
    """Which of corners (N,) at pixels (N, 2) of a picture are taken: what is stronger than most; of those that are
    alike the ones nearest to its middle, for the next picture shows these again, and noise alone ranks them."""
    usual = _ALIKE * float(np.median(strength))
    middle = 0.5 * np.array([shape[1], shape[0]])
    off = np.hypot(*(pixels - middle).T)
    order = np.lexsort((off, np.where(strength > usual, -strength, 0.0)))
    return np.asarray(order[:_MOST_CORNERS])


def find_corners(smooth: Gray, gray: Gray, places: Places, free: Gray) -> Found:
    """Corners, such as where three joints meet, of a picture (H, W) and that denoised()."""
    darkest, brightest, *_ = cv2.minMaxLoc(smooth)
    if brightest - darkest < CORNER_LEVELS:
        return NONE
    strong = _eigenvalues(smooth)
    around = _CORNER_STANDS_OUT * _usual(strong)
    least = np.maximum(max(_CORNER_QUALITY * float(np.max(strong * (free > 0))), CORNER_LEAST), around)
    # beside a lamp it rises up to the lamp's edge: that is no corner, wherever the search ends
    row, column = _where((strong >= least) & (strong >= cv2.dilate(strong, _CORNER_AROUND)) & (free > 0))
    if not len(row):
        return NONE
    first = _first(strong[row, column], np.column_stack([column, row]), strong.shape)
    pixels = np.column_stack([column, row])[first].astype(np.float32)[:, None]
    exact = np.asarray(cv2.cornerSubPix(gray, pixels.copy(), _SUBPIX, (-1, -1), _SUBPIX_UNTIL)).reshape(-1, 2)
    stayed = np.max(np.abs(exact - pixels[:, 0]), axis=1) < _SUBPIX[0]
    strength = strong[row[first], column[first]].astype(np.float64)
    sigma_px = np.hypot(_CORNER_SIGMA_PX, _CORNER_VAGUE_PX / np.sqrt(strength))
    return places.found(exact[stayed].astype(np.float64), sigma_px[stayed], CORNER)
