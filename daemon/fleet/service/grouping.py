"""Claims of new landmarks that may be the same one, by kind and place. Pure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.daemon.fleet.service.claims import Claims, places_and_covariances
from ceilvo.daemon.fleet.service.judge import GATE_CHI2, distance_chi2
from ceilvo.types import Array, Ints

_SIDE = 1 << 26
"""Cells are numbered row by row; chosen: 2600 km of 4 cm, and kinds in what is left of 63 bits."""
_NEIGHBOURS = tuple((i, j) for i in range(-2, 3) for j in range(-2, 3) if (i, j) >= (0, 0))
"""Half of the cells within two; the other half looks back."""
_MOST_TOGETHER = 400
"""Claims that hang together and are compared each with each; chosen: 100 robots see one landmark. More are looked at in
parts: somebody has filled the place with claims."""


@dataclass(frozen=True)
class Group:
    """Claims that agree, each within the gate of the one in their middle.

    Attributes:
        members: (M,) indices.
        xy_m, cov_m2: (M, 2) and (M, 2, 2).
    """

    members: Ints
    xy_m: Array
    cov_m2: Array


def is_enough(claims: Claims, quorum: int) -> bool:
    """Whether so many different keys claim it, or one that needs nobody else."""
    return bool(np.any(claims["alone"])) or len(np.unique(claims["key"])) >= quorum


def groups(claims: Claims, reach_m: float, quorum: int) -> tuple[list[Group], NDArray[np.bool_]]:
    """Groups of claims that are placed and of enough keys, the largest of a place first.

    Also which claims were left out, for their key has another one in the same cell of half the reach: so no key can
    make the work of a place long.
    """
    thinned = np.zeros(len(claims), bool)
    if not len(claims):
        return [], thinned
    xy, cov = places_and_covariances(claims)
    cell = np.floor(np.clip(xy / (0.5 * reach_m), -_SIDE / 2, _SIDE / 2 - 1)).astype(np.int64) + _SIDE // 2
    number = (claims["kind"] * _SIDE + cell[:, 0]) * _SIDE + cell[:, 1]
    order = np.lexsort((claims["ref"], claims["key"], number))
    same = (np.diff(number[order]) == 0) & (np.diff(claims["key"][order]) == 0)
    thinned[order[1:][same]] = True
    left = order[~thinned[order]]
    label = _components(number[left], xy[left], reach_m)
    by_label = np.argsort(label, kind="stable")
    starts = np.flatnonzero(np.diff(label[by_label], prepend=-1))
    parts = np.split(left[by_label], starts[1:])
    some = (p[i : i + _MOST_TOGETHER] for p in parts for i in range(0, len(p), _MOST_TOGETHER))
    found = (g for part in some if is_enough(claims[part], quorum) for g in _agreeing(claims, part, xy, cov))
    return [g for g in found if is_enough(claims[g.members], quorum)], thinned


def _components(number: Ints, xy: Array, reach_m: float) -> Ints:
    """(N,) labels of points that hang together by distances within reach; `number` ascends."""
    pairs = [_pairs(number, number + i * _SIDE + j, (i, j) == (0, 0)) for i, j in _NEIGHBOURS]
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    near = np.hypot(*(xy[a] - xy[b]).T) <= reach_m
    a, b = a[near], b[near]
    label = np.arange(len(number))
    while True:
        before = label.copy()
        np.minimum.at(label, a, label[b])
        np.minimum.at(label, b, label[a])
        label = label[label]
        if np.array_equal(label, before):
            return label


def _pairs(number: Ints, wanted: Ints, within: bool) -> tuple[Ints, Ints]:
    """Indices of points and of those in the cells wanted; within one cell each pair once."""
    low, high = np.searchsorted(number, wanted, "left"), np.searchsorted(number, wanted, "right")
    if within:
        low = np.arange(len(number)) + 1
    count = np.maximum(high - low, 0)
    a = np.repeat(np.arange(len(number)), count)
    offset = np.arange(len(a)) - np.repeat(np.cumsum(count) - count, count)
    return a, np.repeat(low, count) + offset


def _agreeing(claims: Claims, part: Ints, xy: Array, cov: Array) -> list[Group]:
    """Of claims that hang together: around the one that most keys agree with, then of the rest."""
    out = []
    while len(part):
        off = xy[part][:, None] - xy[part][None]
        both = cov[part][:, None] + cov[part][None]
        n = len(part)
        agree = (distance_chi2(off.reshape(-1, 2), both.reshape(-1, 2, 2)) <= GATE_CHI2).reshape(n, n)
        keys = [len(np.unique(claims["key"][part[row]])) for row in agree]
        members = part[agree[int(np.argmax(keys))]]
        out.append(Group(members, xy[members], cov[members]))
        part = part[~np.isin(part, members)]
    return out
