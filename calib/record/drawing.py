"""Drawings of lines, dots, areas and words as SVG, with which plots need no library."""

from __future__ import annotations

import html
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
INK, GREY, PALE, PAPER = "#222222", "#888888", "#dddddd", "#ffffff"
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")
"""Colours of series: four of Okabe and Ito's, which the colour-blind tell apart."""
_SCALE = ("#440154", "#3b528b", "#21918c", "#5ec962", "#fde725")
"""From low to high; even steps of lightness (viridis), readable in grey too."""


@dataclass
class Drawing:
    """Width and height in px; x to the right, y down."""

    width: float
    height: float
    _parts: list[str] = field(default_factory=list)

    def line(self, xy: ArrayLike, colour: str, width: float = 1.5, *, dash: str = "", fill: str = "none") -> None:
        """A line through (N, 2) points, an area where it has a fill."""
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in np.asarray(xy, np.float64).reshape(-1, 2))
        tag = "polyline" if fill == "none" else "polygon"
        dashed = f' stroke-dasharray="{dash}"' if dash else ""
        self._parts.append(
            f'<{tag} points="{points}" fill="{fill}" stroke="{colour}" stroke-width="{width:g}"{dashed}/>'
        )

    def segments(self, starts: ArrayLike, ends: ArrayLike, colours: Iterable[str], width: float = 1.0) -> None:
        """Short lines, each of its colour."""
        for a, b, colour in zip(np.asarray(starts), np.asarray(ends), colours, strict=True):
            self.line((a, b), colour, width)

    def dots(self, xy: ArrayLike, colours: str | Iterable[str], radius: float = 2.5) -> None:
        """Filled circles at (N, 2) points."""
        points = np.asarray(xy, np.float64).reshape(-1, 2)
        each = [colours] * len(points) if isinstance(colours, str) else list(colours)
        for (x, y), colour in zip(points, each, strict=True):
            self._parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" fill="{colour}"/>')

    def ring(self, centre: tuple[float, float], radius: float, colour: str) -> None:
        """A circle's outline."""
        turn = np.linspace(0.0, 2.0 * np.pi, 73)
        self.line(np.array(centre) + radius * np.column_stack([np.cos(turn), np.sin(turn)]), colour)

    def rect(self, x: float, y: float, width: float, height: float, fill: str, stroke: str = "none") -> None:
        self._parts.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" fill="{fill}" stroke="{stroke}"/>'
        )

    def text(
        self,
        x: float,
        y: float,
        words: str,
        *,
        anchor: str = "start",
        size: float = 12.0,
        colour: str = INK,
        up: bool = False,
    ) -> None:
        """One line of words at its base line; `up`: turned to be read from the right."""
        turned = f' transform="rotate(-90 {x:.1f} {y:.1f})"' if up else ""
        self._parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size:g}" fill="{colour}"{turned}>'
            f"{html.escape(words)}</text>"
        )

    def svg(self) -> str:
        """An SVG element that may stand in a page or be a file."""
        w, h = f"{self.width:g}", f"{self.height:g}"
        size = f'width="{w}" height="{h}" viewBox="0 0 {w} {h}"'
        head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">'
        return "\n".join([head, f'<rect width="{w}" height="{h}" fill="#ffffff"/>', *self._parts, "</svg>"]) + "\n"


def shades(values: ArrayLike, low: float, high: float) -> list[str]:
    """The colour of each value between low and high; beyond them that of the end."""
    stops = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in _SCALE], np.float64)
    at = np.clip((np.asarray(values, np.float64) - low) / max(high - low, 1e-12), 0.0, 1.0) * (len(stops) - 1)
    mixed = np.column_stack([np.interp(at, np.arange(len(stops)), stops[:, i]) for i in range(3)])
    return ["#" + "".join(f"{round(v):02x}" for v in rgb) for rgb in mixed.tolist()]


@dataclass(frozen=True)
class Chart:
    """Axes within a drawing: a box in px, and what it shows.

    Attributes:
        box: left, top, right, bottom px.
        x, y: least and greatest value.
        down: y grows downwards, as in pictures.
    """

    drawing: Drawing
    box: tuple[float, float, float, float]
    x: tuple[float, float]
    y: tuple[float, float]
    down: bool = False

    def at(self, xy: ArrayLike) -> Array:
        """(N, 2) px of (N, 2) values."""
        v = np.asarray(xy, np.float64).reshape(-1, 2)
        left, top, right, bottom = self.box
        across = left + (v[:, 0] - self.x[0]) / (self.x[1] - self.x[0]) * (right - left)
        share = (v[:, 1] - self.y[0]) / (self.y[1] - self.y[0])
        return np.column_stack([across, top + share * (bottom - top) if self.down else bottom - share * (bottom - top)])

    def axes(self, x_label: str, y_label: str, title: str = "") -> None:
        """Grid, ticks and words."""
        d, (left, top, right, bottom) = self.drawing, self.box
        for value in ticks(*self.x):
            x = float(self.at((value, self.y[0]))[0, 0])
            d.line(((x, top), (x, bottom)), PALE, 1.0)
            d.text(x, bottom + 15, f"{value:g}", anchor="middle", size=11)
        for value in ticks(*self.y):
            y = float(self.at((self.x[0], value))[0, 1])
            d.line(((left, y), (right, y)), PALE, 1.0)
            d.text(left - 5, y + 4, f"{value:g}", anchor="end", size=11)
        d.rect(left, top, right - left, bottom - top, "none", GREY)
        d.text(0.5 * (left + right), bottom + 32, x_label, anchor="middle")
        d.text(left - 42, 0.5 * (top + bottom), y_label, anchor="middle", up=True)
        if title:
            d.text(0.5 * (left + right), top - 8, title, anchor="middle")

    def legend(self, names: Iterable[tuple[str, str]]) -> None:
        """Names and colours of the series, in the upper right."""
        entries = list(names)
        self.drawing.rect(self.box[2] - 156, self.box[1] + 4, 152, 16 * len(entries) + 4, PAPER)
        for i, (name, colour) in enumerate(entries):
            y = self.box[1] + 16 + 16 * i
            self.drawing.rect(self.box[2] - 150, y - 8, 14, 8, colour)
            self.drawing.text(self.box[2] - 130, y, name, size=11)


def ticks(low: float, high: float) -> list[float]:
    """Round values between low and high, three to seven or so."""
    step = 10.0 ** np.floor(np.log10((high - low) / 3.0))
    step *= max(k for k in (1, 2, 5) if (high - low) / (k * step) >= 3.0 or k == 1)
    first = int(np.ceil(low / step - 1e-9))
    return [round(k * step, 12) + 0.0 for k in range(first, int(np.floor(high / step + 1e-9)) + 1)]


def equal(
    points: ArrayLike, width: float, height: float, margin: float = 1.1
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Ranges of x and y about (N, 2) points in which a metre is as long across as up, for a box of that shape."""
    v = np.asarray(points, np.float64).reshape(-1, 2)
    middle, half = 0.5 * (v.max(axis=0) + v.min(axis=0)), 0.5 * np.ptp(v, axis=0)
    unit = margin * max(float(half[0]) / width, float(half[1]) / height, 1e-9)
    x, y = middle.tolist()
    return (x - unit * width, x + unit * width), (y - unit * height, y + unit * height)


def scale_bar(drawing: Drawing, box: tuple[float, float, float, float], low: float, high: float, label: str) -> None:
    """What the shades mean: a bar from low (below) to high."""
    left, top, right, bottom = box
    steps = 24
    h = (bottom - top) / steps
    for i, colour in enumerate(shades(np.linspace(low, high, steps), low, high)):
        drawing.rect(left, bottom - (i + 1) * h, right - left, h + 0.3, colour)
    for value, y in ((low, bottom), (high, top + 8)):
        drawing.text(right + 4, y, f"{value:.3g}", size=11)
    drawing.text(left - 6, 0.5 * (top + bottom), label, anchor="middle", size=11, up=True)
