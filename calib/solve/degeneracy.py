"""Point layouts from which M cannot be found, each with its own reason, before any fitting is tried."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_FLAT = 0.01
_SMALL_FRACTION = 0.12
_SAME_PX, _SAME_M = 0.5, 1e-4
_CUBIC = 1e-3


def layout_problem(xyz_m: Array, uv_px: Array, size: tuple[int, int], known_lens: bool) -> str:
    """Why the points are no use, "" when they are.

    Args:
        xyz_m: (N, 3) in base, Z = 0 on the ceiling, up.
        uv_px: (N, 2) raw pixels.
        size: width, height of the picture, px.
        known_lens: intrinsics are there; points in one plane then suffice, else M has eleven unknowns.
    """
    return next(_problems(xyz_m, uv_px, size, known_lens), "")


def _problems(xyz: Array, uv: Array, size: tuple[int, int], known_lens: bool) -> Iterator[str]:
    if not (np.isfinite(xyz).all() and np.isfinite(uv).all()):
        yield "a coordinate is not a number"
        return
    need = 4 if known_lens else 6
    if len(xyz) < need:
        yield f"{len(xyz)} points, at least {need} needed with{'' if known_lens else 'out'} a known lens"
        return
    yield from _same(xyz, uv, need)
    yield from _outside(uv, size)
    yield from _shape(xyz, need, known_lens)
    yield from _picture(uv, size)
    yield from _handedness(xyz, uv)
    if not known_lens:
        yield from _general(xyz, uv)


def _same(xyz: Array, uv: Array, need: int) -> Iterator[str]:
    d3 = _distances(xyz)
    d2 = _distances(uv)
    if (i := np.argwhere((d3 < _SAME_M) & (d2 > 20.0))).size:
        yield f"points {i[0][0] + 1} and {i[0][1] + 1} are the same place on the ceiling, but far apart in the picture"
    if (i := np.argwhere((d2 < _SAME_PX) & (d3 > 10 * _SAME_M))).size:
        yield f"points {i[0][0] + 1} and {i[0][1] + 1} are the same pixel, but different places"
    distinct = len(xyz) - len({int(j) for _, j in np.argwhere(d3 < _SAME_M)})
    if distinct < need:
        yield f"only {distinct} of {len(xyz)} points are different places, at least {need} needed"


def _distances(p: Array) -> Array:
    """(N, N) with infinity on and below the diagonal."""
    d = np.linalg.norm(p[:, None] - p[None], axis=2)
    d[np.tril_indices(len(d))] = np.inf
    return np.asarray(d)


def _outside(uv: Array, size: tuple[int, int]) -> Iterator[str]:
    w, h = size
    out = np.flatnonzero((uv < -0.5).any(axis=1) | (uv[:, 0] > w - 0.5) | (uv[:, 1] > h - 0.5))
    if len(out):
        u, v = uv[out[0]]
        hint = "; are u and v swapped?" if (uv[:, 1].max() > h and uv[:, 0].max() < h) else ""
        yield f"point {out[0] + 1} at ({u:.0f}, {v:.0f}) is outside the picture of {w} x {h} px{hint}"


def _shape(xyz: Array, need: int, known_lens: bool) -> Iterator[str]:
    spread = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    if spread[1] < _FLAT * spread[0]:
        yield "all points are on one line; add points to the side of it"
        return
    flat = spread[2] < _FLAT * spread[0]
    if not flat and not known_lens and (k := _but_few(xyz, 2)):
        yield f"all points but {k} are in one plane; hang more of them lower, in different places"
    if flat and not known_lens:
        yield "all points are in one plane, which needs a known lens; run 'calib intrinsics' first or add lower points"
    if flat and _all_but_on_line(xyz, 1):
        yield "all points but one are on one line; add points to the side of it"


def _but_few(xyz: Array, most: int) -> int:
    """How many points (1..most) are off a plane that all the others share, 0 = more, or none."""
    n = len(xyz)
    best = n
    rng = np.random.default_rng(1)
    for _ in range(200):
        three = xyz[rng.choice(n, 3, replace=False)]
        normal = np.cross(three[1] - three[0], three[2] - three[0])
        if np.linalg.norm(normal) < 1e-9:
            continue
        off = np.abs((xyz - three[0]) @ normal / np.linalg.norm(normal))
        best = min(best, int(np.sum(off > _FLAT * np.ptp(xyz, axis=0).max())))
    return best if 0 < best <= most else 0


def _all_but_on_line(xyz: Array, most: int) -> bool:
    n = len(xyz)
    for i in range(n):
        rest = np.delete(xyz, i, axis=0)
        spread = np.linalg.svd(rest - rest.mean(axis=0), compute_uv=False)
        if spread[1] < _FLAT * spread[0]:
            return True
    return False


def _picture(uv: Array, size: tuple[int, int]) -> Iterator[str]:
    spread = np.linalg.svd(uv - uv.mean(axis=0), compute_uv=False)
    if spread[1] < _FLAT * spread[0]:
        yield "the points are on one line in the picture: the camera is in their plane; does it look up?"
    extent = np.ptp(uv, axis=0) / np.array(size)
    if extent.max() < _SMALL_FRACTION:
        yield (
            f"the points cover {100 * extent.max():.0f} % of the picture, at least {100 * _SMALL_FRACTION:.0f} needed; "
            "spread them over the picture"
        )


def _handedness(xyz: Array, uv: Array) -> Iterator[str]:
    """Seen from below, base x to base y turns as the picture's u to v does (docs/coordinates.md)."""
    ground = np.column_stack([xyz[:, :2], np.ones(len(xyz))])
    if np.linalg.matrix_rank(ground, tol=1e-6 * np.linalg.norm(ground)) < 3:
        return
    affine = np.linalg.lstsq(ground, uv, rcond=None)[0][:2].T
    left = uv - ground @ np.linalg.lstsq(ground, uv, rcond=None)[0]
    explained = 1.0 - float(np.sum(left**2)) / float(np.sum((uv - uv.mean(axis=0)) ** 2))
    if explained > 0.8 and np.linalg.det(affine) < 0:
        yield "the picture is a mirror image of the points: x and y, or u and v, are swapped or have the wrong sign"
    elif explained < 0.6:
        yield "the pixels have nothing to do with the points: is the list sorted the same way?"


def _general(xyz: Array, uv: Array) -> Iterator[str]:
    """The DLT's own rank: a twisted cubic or two lines through the camera have more than one solution."""
    x = xyz - xyz.mean(axis=0)
    x = x / max(float(np.sqrt(np.mean(x**2))), 1e-12)
    p = uv - uv.mean(axis=0)
    p = p / max(float(np.sqrt(np.mean(p**2))), 1e-12)
    h = np.column_stack([x, np.ones(len(x))])
    zero = np.zeros_like(h)
    rows = np.concatenate([np.column_stack([h, zero, -p[:, :1] * h]), np.column_stack([zero, h, -p[:, 1:] * h])])
    s = np.linalg.svd(rows, compute_uv=False)
    if s[10] < _CUBIC * s[0]:
        yield "the points and the camera lie on one curve (a twisted cubic, or lines through the camera): move some"
