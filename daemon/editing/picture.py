"""A map from above: landmarks by type, key poses, a scale; and what a change does to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from ceilvo.crossing_types import CORNER, LAMP, LINE_CROSSINGS, SPOT
from ceilvo.daemon.editing.joining import Matches
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.replay.drawing.overlay import (
    BLUE,
    DARK,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    WHITE,
    YELLOW,
    Canvas,
    Colour,
    Image,
    PanelView,
)
from ceilvo.types import Array, Ints, Landmarks

SIZE_PX = 1200
"""Side of the picture; chosen: a hall of 60 m has 5 cm a pixel, and a screen shows it."""
_MARGIN = 0.06
"""Of the map's extent, around it."""
_SMALLEST_M = 2.0
"""That a picture shows, so that one landmark is not all of it."""
_DOT_PX, _SMALL_DOT_PX, _MANY = 2, 1, 20_000
"""Half the side of a landmark's square, and of one of very many."""
_HEADING_PX = 9.0
_LINE_PX = 18
"""From one line of text to the next."""
_BAR_SHARE = 0.2
"""Of the picture's width, that the scale bar takes at most."""

TYPES: Mapping[str, Colour] = {
    "joint with joint": GREEN,
    "joint with edge": YELLOW,
    "edge with edge": VERMILION,
    "lamp": WHITE,
    "spot": PURPLE,
    "corner": ORANGE,
}


@dataclass(frozen=True)
class Change:
    """What is drawn of a change, in m: points that go and come (N, 2), and those that move, from and to (N, 2)."""

    removed: Array = field(default_factory=lambda: np.empty((0, 2)))
    added: Array = field(default_factory=lambda: np.empty((0, 2)))
    moved_from: Array = field(default_factory=lambda: np.empty((0, 2)))
    moved_to: Array = field(default_factory=lambda: np.empty((0, 2)))

    @staticmethod
    def of(a: Landmarks, b: Landmarks, m: Matches, sigmas: float = 0.0) -> Change:
        """From a to b; what moved by more than so many sigmas."""
        other = m.moved(sigmas)
        at = a.xy_map_m[m.a[other]], b.xy_map_m[m.b[other]]
        return Change(a.xy_map_m[m.only_a], b.xy_map_m[m.only_b], *at)


def class_of(kind: Ints) -> Ints:
    """(N,) place in TYPES of landmarks' types (N,)."""
    edges = (kind // 3 != 1).astype(np.int64) + (kind % 3 != 1)
    points = np.select([kind == LAMP, kind == SPOT, kind == CORNER], [3, 4, 5], 0)
    return np.where(kind < LINE_CROSSINGS, edges, points)


def draw(content: MapContent, caption: str, change: Change | None = None) -> Image:
    """(SIZE_PX, SIZE_PX, 3) BGR: x right, y up; with a change what stays is grey."""
    change_ = change or Change()
    own = content.landmarks.xy_map_m
    poses = [k.pose for k in content.key_poses]
    view = _view([own, change_.removed, change_.moved_from, *(p[:, :2] for p in poses)])
    canvas = Canvas(np.full((SIZE_PX, SIZE_PX, 3), DARK, np.uint8))
    for pose in poses:
        _draw_poses(canvas, view, pose)
    half = _DOT_PX if len(own) < _MANY else _SMALL_DOT_PX
    legend: list[tuple[str, Colour]] = []
    kinds = class_of(content.landmarks.crossing_type)
    for i, (name, colour) in enumerate(TYPES.items()):
        if np.any(kinds == i):
            _dots(canvas, view.pixels(own[kinds == i]), GREY if change else colour, half)
            legend += [] if change else [(f"{int(np.sum(kinds == i))} {name}", colour)]
    if change:
        legend += _draw_change(canvas, view, change, half)
    if poses:
        legend.append((f"{sum(map(len, poses))} key poses", BLUE))
    _draw_words(canvas, view, [(caption, WHITE), *legend])
    return canvas.image


def _view(points: list[Array]) -> PanelView:
    at = np.vstack([np.empty((0, 2)), *points])
    low, high = (at.min(axis=0), at.max(axis=0)) if len(at) else (np.zeros(2), np.zeros(2))
    centre, half = 0.5 * (low + high), 0.5 * max(float(np.max(high - low)), _SMALLEST_M) * (1.0 + 2.0 * _MARGIN)
    return PanelView((*(centre - half), *(centre + half)), SIZE_PX)


def _draw_change(canvas: Canvas, view: PanelView, change: Change, half: int) -> list[tuple[str, Colour]]:
    start, end = view.pixels(change.moved_from), view.pixels(change.moved_to)
    for tail, tip in zip(start, end, strict=True):
        canvas.curve(np.stack([tail, tip]), ORANGE)
    _dots(canvas, end, ORANGE, half)
    _dots(canvas, view.pixels(change.removed), VERMILION, half)
    _dots(canvas, view.pixels(change.added), SKY, half)
    return [
        (f"{len(change.removed)} removed", VERMILION),
        (f"{len(change.added)} added", SKY),
        (f"{len(end)} moved", ORANGE),
        ("the same", GREY),
    ]


def _draw_poses(canvas: Canvas, view: PanelView, pose: Array) -> None:
    uv = view.pixels(pose[:, :2])
    tips = uv + _HEADING_PX * np.column_stack([np.cos(pose[:, 2]), -np.sin(pose[:, 2])])
    for tail, tip in zip(uv, tips, strict=True):
        canvas.arrow(tail, tip, BLUE)


def _dots(canvas: Canvas, uv: Array, colour: Colour, half: int) -> None:
    """Squares, all at once: a map may have 100,000."""
    height, width = canvas.image.shape[:2]
    middle = np.rint(uv).astype(np.int64)
    for dy in range(-half, half + 1):
        for dx in range(-half, half + 1):
            x, y = middle[:, 0] + dx, middle[:, 1] + dy
            inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
            canvas.image[y[inside], x[inside]] = colour


def _draw_words(canvas: Canvas, view: PanelView, lines: list[tuple[str, Colour]]) -> None:
    for i, (text, colour) in enumerate(lines):
        canvas.text(8, _LINE_PX * (i + 1), text.encode("ascii", "replace").decode(), colour)
    length_m = _bar_m(_BAR_SHARE * view.span_m)
    end = 12 + round(length_m * view.px_per_m)
    cv2.rectangle(canvas.image, (12, SIZE_PX - 16), (end, SIZE_PX - 12), WHITE, -1)
    canvas.text(end + 8, SIZE_PX - 10, f"{length_m:g} m")


def _bar_m(most_m: float) -> float:
    """1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(most_m))
    return float(power * max(s for s in (1.0, 2.0, 5.0) if s * power <= most_m))
