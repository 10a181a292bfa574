"""The loops in NumPy: what the compiled ones compute, and what runs where there are none."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.relocalisation.kernel.arguments import (
    COVERAGE_OFFSET,
    COVERAGE_SIDE,
    END,
    LINE_FEATURES,
    Bits,
    Bools,
    Chains,
    Fine,
    Ground,
    Raster,
    Ratios,
    Slots,
    check_length,
)
from ceilvo.types import Array, Ints

# -- landmarks near points


def pairs(chains: Chains, points: Fine, reach: int) -> tuple[Ints, Slots]:
    """All pairs of a point (Q, 2) and the slot of a landmark within reach of it along both axes, in any order."""
    numbers = _numbers(chains, *_touched(points, reach, chains.shift).T).astype(np.int64)
    count = len(chains.head)
    point, numbers = np.divmod(np.unique((np.arange(len(numbers)) % max(len(points), 1)) * count + numbers), count)
    found = [(np.empty(0, np.int64), np.empty(0, np.int32))]
    for which, slot in walk(chains.head, chains.chain, numbers.astype(np.int32)):
        mine = point.take(which)
        off = np.abs(chains.xy.take(slot, axis=0) - points.take(mine, axis=0))
        on = np.flatnonzero(np.max(off, axis=1) <= reach)
        found.append((mine.take(on), slot.take(on)))
    which_of, slots = zip(*found, strict=True)
    return np.concatenate(which_of), np.concatenate(slots)


def nearest(chains: Chains, points: Fine, wanted: Bits, reach: int) -> tuple[Slots, Array]:
    """For each point (Q, 2) the slot of the nearest landmark of the types whose bits (Q,) are set, or -1, and how far
    it is; the distance counts within reach only.

    Args:
        reach: no more than a block.
    """
    best, label = np.full(len(points), np.inf), np.full(len(points), END, np.int32)
    corners = ((-reach, -reach), (-reach, reach), (reach, -reach), (reach, reach))
    shift = chains.shift
    blocks = np.array(
        [_numbers(chains, (points[:, 0] + dx) >> shift, (points[:, 1] + dy) >> shift) for dx, dy in corners], np.int32
    )
    for i in range(1, 4):
        blocks[i, np.any(blocks[:i] == blocks[i], axis=0)] = 0  # there is nothing in block 0
    for number in blocks:
        for which, slot in walk(chains.head, chains.chain, number):
            off = (chains.xy.take(slot, axis=0) - points.take(which, axis=0)).astype(np.float64)
            apart = np.hypot(off[:, 0], off[:, 1])
            own = np.left_shift(np.uint16(1), chains.crossing_type.take(slot).astype(np.uint16))
            closer = np.flatnonzero((apart < best.take(which)) & (own & wanted.take(which) > 0))
            best[which[closer]], label[which[closer]] = apart[closer], slot[closer]
    label[best > reach] = END
    return label, best


def _numbers(chains: Chains, column: Ints, row: Ints) -> Slots:
    """Of the blocks in columns and rows; 0, where nothing is, for those that there are not."""
    w, h = chains.number.shape
    column, row = column - chains.origin[0], row - chains.origin[1]
    inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
    return np.where(inside, chains.number.reshape(-1).take(np.where(inside, column * h + row, 0)), 0).astype(np.int32)


def walk(head: Slots, chain: Slots, numbers: Slots) -> Iterator[tuple[Ints, Slots]]:
    """All landmarks in blocks (Q,), in parts: which of the blocks, and a slot in it."""
    which, slot = np.arange(len(numbers)), head.take(numbers)
    while True:
        on = np.flatnonzero(slot >= 0)
        if not len(on):
            return
        which, slot = which.take(on), slot.take(on)
        yield which, slot
        slot = chain.take(slot)


def _touched(xy: Fine, reach: int, shift: int) -> Fine:
    """(C, 2) places of all blocks that squares of +-reach around points (N, 2) touch, some more than once."""
    steps = np.linspace(-reach, reach, 2 + 2 * reach // (1 << shift)).astype(np.int32)
    corners = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 1, 2)
    return (xy + corners).reshape(-1, 2) >> shift


# -- pictures to look into


def stamped(cells: Bits, place: Ints, bits: Bits, disc: NDArray[np.uint8]) -> None:
    """Set bits (N,) in a picture (H, W), in place, where discs (S, S) about places (N, 2) are not 0; S is odd."""
    check_length("disc", disc.shape[0] % 2, 1)
    half = disc.shape[0] // 2
    for v, u in np.argwhere(disc) - half:
        column, row = place[:, 0] + u, place[:, 1] + v
        inside = (column >= 0) & (row >= 0) & (column < cells.shape[1]) & (row < cells.shape[0])
        np.bitwise_or.at(cells, (row[inside], column[inside]), bits[inside])


def looked_up(raster: Raster, xy: Array) -> Bits:
    """(N,) bits at points (N, 2), m; 0 outside of the picture."""
    cell = np.floor(xy * (1.0 / raster.cell_m)).astype(np.int64) - raster.low
    column, row = cell[:, 0], cell[:, 1]
    height, width = raster.cells.shape
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    flat = np.where(inside, row * width + column, 0)
    return np.asarray(np.where(inside, raster.cells.reshape(-1)[flat], np.uint16(0)), np.uint16)


def views(ground: Ground, xy: Array) -> Ints:
    """(N,) views that showed the ground at points (N, 2), m."""
    cell = np.floor(xy / ground.cell_m).astype(np.int64)
    if not len(ground.block):
        return np.zeros(len(cell), np.int64)
    block, inside = cell // COVERAGE_SIDE + COVERAGE_OFFSET, cell % COVERAGE_SIDE
    number = block[:, 0] * (2 * COVERAGE_OFFSET) + block[:, 1]
    at = np.minimum(np.searchsorted(ground.block, number), len(ground.block) - 1)
    shown = ground.shown[at, inside[:, 0], inside[:, 1]]
    return np.where(ground.block[at] == number, shown, 0).astype(np.int64)


def alike(
    raster: Raster, ground: Ground, known_views: int, xy: Array, kind: Ints, shifts: Array, types: int, rare: int
) -> Array:
    """(3, S, T) landmarks of each type that shifts (S, 2) move onto known ground; those of them that find their like
    there, and those that find any rare one.

    Args:
        raster: of the map's types.
        ground: known from so many views on.
        xy, kind: (L, 2) landmarks, m, and their types.
        types: how many there are, T.
        rare: bit that says that something rare is there.
    """
    there = xy + shifts[:, None]
    at, shape = there.reshape(-1, 2), there.shape[:2]
    known, bits = views(ground, at).reshape(shape) >= known_views, looked_up(raster, at).reshape(shape)
    same = ((bits >> kind.astype(np.uint16)) & np.uint16(1) > 0) & known
    anyone = same | ((bits & np.uint16(rare)) > 0) & known
    of = np.eye(types)[kind]
    return np.stack([known @ of, same @ of, anyone @ of])


# -- what a view says of places


def scored(ratios: Ratios, views: Ints, types: Ints, matched: Bools, other: Bools, worth: Array, lines: Ints) -> Array:
    """(M, R) log-likelihood ratios of what is seen at M places, added up over the K features.

    Args:
        views: (M, K) of the ground where a feature is.
        types: (M, K) as it would be named there.
        matched, other: (M, K) whether a landmark of its type is there, and whether one of another type is.
        worth: (R, K) of the features.
        lines: (K, 2) numbers of the lines that meet at a feature.
    """
    return np.asarray(np.einsum("mkr,rk->mr", each_of(ratios, views, types, matched, other, lines), worth))


def each_of(ratios: Ratios, views: Ints, types: Ints, matched: Bools, other: Bools, lines: Ints) -> Array:
    """(M, K, R) of each feature, but for its worth; as of scored()."""
    step = views // ratios.views_per_step
    none = np.where(other[..., None], ratios.mistaken[step, types], ratios.loss[step, types])
    each = np.where(matched[..., None], ratios.gain[step, types], none)
    is_known = views >= ratios.known_views
    known = np.where(matched, np.minimum(views / ratios.known_views, 1.0), worth_by_line(~matched & is_known, lines))
    return np.asarray(each * known[..., None])


def missed(
    raster: Raster,
    poses: Array,
    xy: Array,
    own: Bits,
    turns: Ints,
    visible: int,
    rare: int,
    surprise: Array,
    lines: Ints,
) -> Array:
    """(M, R) log-likelihood ratios of landmarks that should be seen from poses (M, 3) and are not, added up.

    Args:
        raster: of the view, in base.
        xy: (N, 2) landmarks in map.
        own: (4, N) the bit of a landmark's type, as a view turned by so many quarters names it.
        turns: (M,) quarter turns of the view.
        visible, rare: bits that say that a cell is in view, and that something rare is there.
        surprise: (N, R) what it says that a landmark is not seen.
        lines: (N, 2) numbers of the lines that meet at a landmark.
    """
    off = xy - poses[:, None, :2]
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    back = np.stack([c * off[..., 0] + s * off[..., 1], c * off[..., 1] - s * off[..., 0]], axis=-1)
    bits = looked_up(raster, back.reshape(-1, 2)).reshape(back.shape[:2])
    gone = (bits & np.uint16(visible) > 0) & (bits & own[turns] == 0) & (bits & np.uint16(rare) == 0)
    return np.asarray(worth_by_line(gone, lines) @ surprise)


def worth_by_line(events: Bools, lines: Ints) -> Array:
    """(M, K) of events (M, K) at crossings of lines (K, 2); of those along one line LINE_FEATURES in all at most."""
    most = np.ones(events.shape)
    for axis in (0, 1):
        number, index = np.unique(lines[:, axis], return_inverse=True)
        on_line = np.eye(len(number))[index.reshape(-1)]
        np.maximum(most, (events @ on_line)[:, index.reshape(-1)], out=most)
    return np.where(events, np.minimum(LINE_FEATURES / most, 1.0), 0.0)
