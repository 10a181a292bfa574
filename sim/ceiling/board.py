"""The faces of ceiling boards: speckle as a factor on their albedo, drawn with the texture's own resolution.

What is finer than a texel is not sampled but spread: a pinhole of 1 mm takes its share of light from the texels it lies
between, so that nothing sparkles where the picture is read at other places.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_MOTTLE, _MOTTLE_TEXELS, _GRAIN = 0.010, 24, 0.022
"""Of mineral board, relative: mottling, and over how many texels; grain of single texels; chosen."""
_FISSURES, _FISSURE_DEPTH, _FISSURE_TEXELS = 0.012, 0.7, 0.8
"""Of mineral board: how many texels have one, how dark, how wide (sigma); chosen."""
_BOARD_FROM, _BOARD_TO = 0.2, 1.3
"""Of all that together."""

CLOUDS_MM = (4.0, 8.0, 16.0, 32.0, 64.0, 128.0, 256.0, 512.0)
"""Bounds of the octaves of wavelength in which a tile's clouds are measured."""
CLOUDS_RMS = (0.0009, 0.0010, 0.0014, 0.0018, 0.0026, 0.0046, 0.0059)
"""Relative brightness in each octave, rms: measured inside the 240 plain tiles of a CC0 picture of a suspended ceiling
(ambientCG OfficeCeiling006, tiles of 0.6 m 256 samples wide), with its sRGB curve taken off. That picture has clouds
only, neither pinholes nor fissures: 0.2 % rms is all there is below 14 mm, as often bright as dark."""
PINHOLES_PER_M2, PINHOLE_M, _PINHOLE_SPREAD = 9000.0, 0.0012, 0.3
"""Of a fissured board: how many, median diameter, standard deviation of its logarithm; chosen, as all below, because no
picture at hand resolves them."""
FISSURES_PER_M2, FISSURE_LENGTH_M, FISSURE_WIDTH_M = 700.0, 0.009, 0.0015
"""How many, mean length (exponential, from _FISSURE_LEAST_M) and width."""
_FISSURE_LEAST_M, _FISSURE_MOST_M, _FISSURE_STEP_M = 0.003, 0.030, 0.001
"""Shortest, longest, and the way from one point of a fissure to the next."""
_FISSURE_TURN_RAD, _FISSURE_BEND_RAD = 0.5, 0.25
"""Standard deviation of a fissure's direction from the board's, which is its x, and of the bend from point to point."""
HOLE_DEPTH = 0.7
"""How much darker a hole is than the face around it: a part of the light comes back."""


def mineral(size: tuple[int, int], amount: float, rng: np.random.Generator) -> Array32:
    """Mottling, grain and small dark fissures as a factor (H, W), from (W, H) texels: what a texel has, not a mm."""
    w, h = size
    out = np.ones((h, w), np.float32)
    if amount <= 0:
        return out
    amount32 = np.float32(amount)
    coarse = rng.standard_normal((h // _MOTTLE_TEXELS + 2, w // _MOTTLE_TEXELS + 2), dtype=np.float32)
    out += _MOTTLE * amount32 * cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)
    grain = rng.standard_normal((h, w), dtype=np.float32)
    out += _GRAIN * amount32 * grain
    holes = (rng.random((h, w), dtype=np.float32) < _FISSURES).astype(np.float32)
    out -= _FISSURE_DEPTH * amount32 * cv2.GaussianBlur(holes, (0, 0), _FISSURE_TEXELS)
    return np.asarray(np.clip(out, _BOARD_FROM, _BOARD_TO), np.float32)


def fibre(size: tuple[int, int], texel_m: float, amount: float, rng: np.random.Generator) -> Array32:
    """A fissured mineral-fibre board as a factor (H, W), from (W, H) texels: clouds, pinholes, fissures.

    Args:
        amount: of how many pinholes and fissures; 1 is a board with as many as PINHOLES_PER_M2 and FISSURES_PER_M2 say.
    """
    covered = np.minimum(holes(size, texel_m, amount, rng), 1.0)
    return np.asarray(clouds(size, texel_m, rng) * (1.0 - HOLE_DEPTH * covered), np.float32)


def clouds(size: tuple[int, int], texel_m: float, rng: np.random.Generator) -> Array32:
    """Slow changes of brightness as a factor (H, W) about 1, octave by octave as CLOUDS_RMS; octaves that texels cannot
    show are left out."""
    w, h = size
    out = np.ones((h, w), np.float32)
    for shortest_mm, longest_mm, rms in zip(CLOUDS_MM, CLOUDS_MM[1:], CLOUDS_RMS, strict=False):
        cell = 0.5e-3 * np.sqrt(shortest_mm * longest_mm) / texel_m  # half a wave
        if cell < 1.0:
            continue
        lattice = rng.standard_normal((int(h / cell) + 3, int(w / cell) + 3), dtype=np.float32)
        at = [((np.arange(n) / cell) + 1.0).astype(np.float32) for n in (w, h)]
        x, y = np.meshgrid(*at)
        wave = cv2.remap(lattice, x, y, cv2.INTER_CUBIC)
        out += np.float32(rms / max(float(wave.std()), 1e-9)) * wave
    return out


def holes(size: tuple[int, int], texel_m: float, amount: float, rng: np.random.Generator) -> Array32:
    """(H, W) share of each texel that is pinhole or fissure; above 1 where they lie over each other."""
    w, h = size
    area_m2 = w * h * texel_m**2
    pinholes = rng.poisson(PINHOLES_PER_M2 * amount * area_m2)
    at = rng.random((pinholes, 2)) * (w, h)
    diameter = PINHOLE_M * np.exp(_PINHOLE_SPREAD * rng.standard_normal(pinholes))
    out = _spread(at, 0.25 * np.pi * (diameter / texel_m) ** 2, size)
    points, share = _fissures(rng.poisson(FISSURES_PER_M2 * amount * area_m2), size, texel_m, rng)
    out += _spread(points, share, size)
    return out


def _fissures(count: int, size: tuple[int, int], texel_m: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """(N, 2) points along all fissures in texels, (N,) area of each in texels."""
    length = np.clip(rng.exponential(FISSURE_LENGTH_M, count), _FISSURE_LEAST_M, _FISSURE_MOST_M)
    steps = int(_FISSURE_MOST_M / _FISSURE_STEP_M)
    bends = _FISSURE_BEND_RAD * rng.standard_normal((count, steps))
    bends[:, 0] = _FISSURE_TURN_RAD * rng.standard_normal(count)
    turned = np.cumsum(bends, axis=1)
    way = np.stack([np.cos(turned), np.sin(turned)], axis=2) * (_FISSURE_STEP_M / texel_m)
    at = rng.random((count, 1, 2)) * size + np.cumsum(way, axis=1)
    there = np.arange(steps) * _FISSURE_STEP_M < length[:, None]
    area = FISSURE_WIDTH_M * _FISSURE_STEP_M / texel_m**2
    return at[there], np.full(int(there.sum()), area)


def _spread(at: Array, mass: Array, size: tuple[int, int]) -> Array32:
    """(H, W) sum of masses, each shared among the four texels that it lies between; outside goes round."""
    w, h = size
    first = np.floor(at - 0.5).astype(np.int64)
    part = at - 0.5 - first
    out = np.zeros(w * h)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = (part[:, 0] if dx else 1.0 - part[:, 0]) * (part[:, 1] if dy else 1.0 - part[:, 1])
        index = (first[:, 1] + dy) % h * w + (first[:, 0] + dx) % w
        out += np.bincount(index, mass * share, w * h)
    return np.asarray(out.reshape(h, w), np.float32)


_WOOD_WAVES_M = ((0.004, 0.25), (0.012, 0.6), (0.035, 1.5))
"""Across and along the grain: half waves of wood's streaks; chosen, as the two below."""
_WOOD_STREAK, _WOOD_SLAT = 0.07, 0.14
"""Relative brightness: each streak, and a whole slat, rms."""


def wood(slat: NDArray[np.int64], size: tuple[int, int], texel_m: float, rng: np.random.Generator) -> Array32:
    """Slats of wood that run along y as a factor (H, W): each its own brightness and grain.

    Args:
        slat: (W,) which one each column belongs to, from 0.
    """
    w, h = size
    slats = int(slat.max()) + 1
    begins = rng.uniform(0.0, 1e3, slats)[slat]  # each is cut from another board
    out = np.ones((h, w), np.float32) + np.float32(_WOOD_SLAT) * rng.standard_normal(slats).astype(np.float32)[slat]
    for across_m, along_m in _WOOD_WAVES_M:
        cells = (max(across_m / texel_m, 1.0), along_m / texel_m)
        lattice = rng.standard_normal((int(h / cells[1]) + 64, int(w / cells[0]) + 3), dtype=np.float32)
        x = np.broadcast_to((np.arange(w) / cells[0] + 1.0).astype(np.float32), (h, w))
        y = (np.arange(h)[:, None] / cells[1] + begins[None, :] % 60.0).astype(np.float32)
        wave = cv2.remap(lattice, np.ascontiguousarray(x), y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        out += np.float32(_WOOD_STREAK) * wave
    return np.asarray(np.clip(out, _BOARD_FROM, _BOARD_TO), np.float32)
