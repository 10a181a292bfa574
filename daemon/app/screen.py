"""The live screen of `ceilvod run` in a terminal: fixed layout, four times a second, readable at 80x24.

It has no thread: the main loop calls update() as often as it likes. Without a terminal a plain line every 5 s instead.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from types import TracebackType

import numpy as np
from numpy.typing import NDArray
from rich.cells import cell_len
from rich.console import Console
from rich.live import Live
from rich.text import Text

from ceilvo.daemon.app.telemetry import ShownBase, Snapshot
from ceilvo.types import State

Array = NDArray[np.float64]

REDRAW_S = 0.25
"""Between pictures; chosen: figures that change faster cannot be read."""
PLAIN_PERIOD_S = 5.0
"""Between lines where there is no terminal; chosen: for logs."""
WIDTH, HEIGHT = 80, 23
"""Characters: the smallest usual terminal, 80x24, without its last line."""
_LEFT, _LABEL = 44, 11
"""Characters of the figures and of their labels; a space, and the map has the rest of the line."""
_LEAST_MAP, _LEAST_ROWS = 12, 6
"""Characters of a map across that still shows where the robot is, and lines beside it; chosen."""
_AROUND_PLOT = 6
"""Lines of headline, rule, events and the last line."""
_EVENTS = 3
"""Latest events shown."""
_CELL_ASPECT = 2.0
"""Height of a character over its width, as usual fonts have it."""
_TITLE = 26
"""Characters of the title at most; chosen: leaves half of the line to the reason."""
_EXTENT_MARGIN_M = 0.2
"""Around all that is plotted; chosen: nothing stands on the frame."""
_LEAST_M_PER_COLUMN = 1e-6
"""Of the plot, where everything is in one place."""
_STYLE = {
    State.INIT: "bold cyan",
    State.TRACKING: "bold green",
    State.DEGRADED: "bold yellow",
    State.DEAD_RECKONING: "bold yellow",
    State.LOST: "bold red",
    State.RELOCALISING: "bold magenta",
    State.STOPPED: "bold",
}
_ARROWS, _ASCII_ARROWS = "→↗↑↖←↙↓↘", "E7N7W7S7"
_UNICODE = {"landmark": "·", "path": "∙", "truth": "○", "box": "┌┐└┘─│"}
_ASCII = {"landmark": ".", "path": ":", "truth": "o", "box": "++++-|"}


class Screen:
    """Use as a context manager around the main loop; it gives the terminal back as it was.

    While it is up nothing else may write to the terminal: send log lines to Snapshot.events.
    """

    def __init__(self, console: Console | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._console = console if console is not None else Console(highlight=False)
        self._clock = clock
        self._due_s = -math.inf
        self._live: Live | None = None

    @property
    def plain(self) -> bool:
        return not self._console.is_terminal

    def __enter__(self) -> Screen:
        if not self.plain:
            self._live = Live(Text(""), console=self._console, screen=True, auto_refresh=False)
            self._live.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def update(self, snapshot: Snapshot | Callable[[], Snapshot]) -> bool:
        """Draw if it is time to; a callable is asked for its snapshot only then. True when something was drawn."""
        now_s = self._clock()
        if now_s < self._due_s:
            return False
        self._due_s = now_s + (PLAIN_PERIOD_S if self._live is None else REDRAW_S)
        shown = snapshot() if callable(snapshot) else snapshot
        if self._live is None:
            line = status_line(shown)
            self._console.print(Text(line if _is_utf8(self._console) else _ascii(line)), soft_wrap=True)
        else:
            width, height = self._console.size
            self._live.update(render(shown, _is_utf8(self._console), width, height - 1), refresh=True)
        return True


def _is_utf8(console: Console) -> bool:
    return console.encoding.lower().replace("-", "") == "utf8"


def status_line(s: Snapshot) -> str:
    """One plain line."""
    x, y, theta = _pose(s.pose)
    parts = [f"{s.uptime_s:7.1f} s {s.state.name}", f"x {x:.3f} y {y:.3f} m theta {theta:.1f} deg"]
    if s.error is not None:
        parts.append(f"error {s.error[0] * 1e3:.0f} mm {math.degrees(s.error[1]):.2f} deg")
    parts.append(f"{s.fps:.1f} fps, {s.drops} dropped")
    if s.base is not None:
        parts.append(f"base {s.base.sent} sent, {s.base.failed} failed")
    if s.state is not State.TRACKING:
        parts.append(s.reason)
    return ", ".join(parts)


def render(s: Snapshot, unicode: bool = True, width: int = WIDTH, height: int = HEIGHT) -> Text:
    """The whole screen, `height` lines of at most `width` - 1 characters, or as many as the figures need.

    The map takes all the room that there is beside the figures; where that is too little for one it is left out.
    """
    line, rows = max(width - 1, _LEFT), max(height - _AROUND_PLOT, _LEAST_ROWS)
    map_width = line - _LEFT - 1
    signs, arrows = (_UNICODE, _ARROWS) if unicode else (_ASCII, _ASCII_ARROWS)
    left = _figures(s, unicode, rows)
    right = []
    if map_width >= _LEAST_MAP:
        right = [Text(row, style="dim") for row in plot(s, map_width, rows, signs, arrows)]
    for row in right:
        row.highlight_regex(f"[{arrows}{signs['truth']}]", "not dim bold")
    out = Text(no_wrap=True, overflow="crop", end="")
    out.append_text(_headline(s, line))
    for k in range(rows):
        out.append("\n")
        out.append_text(left[k] if k < len(left) else Text(" " * _LEFT))
        if right:
            out.append(" ")
            out.append_text(right[k])
    out.append("\n" + signs["box"][4] * line, style="dim")
    events = [_clip(e, line) for e in s.events[-_EVENTS:]]
    for event in [*events, *[""] * (_EVENTS - len(events))]:
        out.append(f"\n{event}", style="dim")
    out.append("\n")
    out.append("Ctrl-C stops", style="dim")
    if not unicode:
        out.plain = _ascii(out.plain)
    return out


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode("ascii")


def _headline(s: Snapshot, width: int) -> Text:
    minutes, seconds = divmod(int(s.uptime_s), 60)
    clock = f"{minutes // 60:d}:{minutes % 60:02d}:{seconds:02d}"
    line = Text(f"{_clip(s.title, _TITLE)}  ")
    line.append(f"{s.state.name:<14}", style=_STYLE[s.state])
    room = max(width - line.cell_len - len(clock) - 1, 0)
    line.append(f"{_clip(s.reason, room):<{room}} {clock}")
    line.truncate(width)
    return line


def _belief(s: Snapshot) -> str:
    """Ancestors where particles have them, else how likely it is that the robot is at this place."""
    if s.unique_ancestors is not None:
        return f"{s.unique_ancestors} of {s.particles} kept"
    return f"{100.0 * (1.0 - s.elsewhere):.3g} % in one place"


def _figures(s: Snapshot, unicode: bool, lines: int) -> list[Text]:
    (x, y, theta), (sx, sy, st) = _pose(s.pose), _pose(s.sigma)
    plus_minus = "±" if unicode else "+-"
    rows = [
        _row("x", f"{x:9.3f} {plus_minus} {sx:.3f} m"),
        _row("y", f"{y:9.3f} {plus_minus} {sy:.3f} m"),
        _row("heading", f"{theta:9.2f} {plus_minus} {st:.2f} deg"),
        _row("true error", "  unknown" if s.error is None else _error(s.error)),
        _row("quality", f"{s.quality:9.2f}"),
        _row("camera", f"{s.fps:6.1f} fps, {s.drops} dropped"),
        _row("vision", f"{s.crossings:6d} crossings, {s.inliers} inliers"),
        _row("filter", f"{100 * s.ess_ratio:6.0f} % ESS, {_belief(s)}"),
        _row("map", f"{s.landmarks:6d} landmarks, NIS {s.nis:.2f}"),
        _row("base", _base(s.base)),
        _row("zenoh", "   off" if s.zenoh_samples is None else f"{s.zenoh_samples:6d} samples"),
        _row("latency", "median and p99, ms"),
    ]
    cells = [f"{_clip(name, 10):<10}{_ms(median)}{_ms(p99)}" for name, (median, p99) in s.latency_ms.items()]
    room = 2 * max(lines - len(rows), 0)
    if not room:
        return rows[:lines]
    cells = cells if len(cells) <= room else [*cells[: room - 1], cells[-1]]
    for k in range(0, len(cells), 2):
        rows.append(Text(f"{'  '.join(cells[k : k + 2]):<{_LEFT}}"))
    return rows


def _row(name: str, value: str) -> Text:
    line = Text(f"{name:<{_LABEL}}", style="dim")
    return line.append(f"{_clip(value, _LEFT - _LABEL):<{_LEFT - _LABEL}}", style="not dim")


def _ms(value: float) -> str:
    """Five characters of which the first is a blank: the figure before it ends where this begins."""
    if value < 99.95:
        return f"{value:5.1f}"
    return f"{value:5.0f}" if value < 999.5 else "  >1s"


def _error(error: tuple[float, float]) -> str:
    return f"{error[0] * 1e3:9.1f} mm, {math.degrees(error[1]):+.3f} deg"


def _base(link: ShownBase | None) -> str:
    if link is None:
        return "   off"
    age = "silent" if link.age_s is None else f"{min(link.age_s * 1e3, 99999):6.0f} ms ago"
    return f"{age}, {link.sent} sent, {link.failed} bad"


def _pose(p: Array) -> tuple[float, float, float]:
    return float(p[0]), float(p[1]), math.degrees(float(p[2]))


def _clip(text: str, width: int) -> str:
    """One line of printable characters, one cell wide each, at most `width` of them."""
    line = "".join(c if c.isprintable() and cell_len(c) == 1 else "?" for c in text)
    return line if len(line) <= width else line[: max(width - 3, 0)] + "..."


def plot(s: Snapshot, width: int, rows: int, signs: Mapping[str, str] = _UNICODE, arrows: str = _ARROWS) -> list[str]:
    """Top-down view of the room, x to the right and y up, `rows` lines of `width` characters with a frame."""
    view = _view(s, width - 2, rows - 2)
    canvas = [[" "] * (width - 2) for _ in range(rows - 2)]

    def put(xy: Array, sign: str) -> None:
        column, row = view(float(xy[0]), float(xy[1]))
        if 0 <= column < width - 2 and 0 <= row < rows - 2:
            canvas[row][column] = sign

    for name, points in (("path", s.path_xy_m), ("landmark", s.landmarks_xy_m)):
        for xy in () if points is None else points:
            put(xy, signs[name])
    if s.truth is not None:
        put(s.truth, signs["truth"])
    if np.all(np.isfinite(s.pose)):
        put(s.pose, arrows[round(float(s.pose[2]) / (0.25 * math.pi)) % 8])
    a, b, c, d, h, v = tuple(signs["box"])
    return [a + h * (width - 2) + b, *[v + "".join(r) + v for r in canvas], c + h * (width - 2) + d]


def _view(s: Snapshot, columns: int, rows: int) -> Callable[[float, float], tuple[int, int]]:
    """Map metres to a character cell with the same scale along x and y (a cell is twice as high as wide)."""
    x0, y0, x1, y1 = s.room_m if s.room_m is not None else _extent(s)
    scale = max((x1 - x0) / columns, (y1 - y0) / (rows * _CELL_ASPECT), _LEAST_M_PER_COLUMN)  # metres a column
    cx, cy = 0.5 * (x0 + x1), 0.5 * (y0 + y1)

    def cell(x: float, y: float) -> tuple[int, int]:
        if not (math.isfinite(x) and math.isfinite(y)):
            return -1, -1
        return (
            math.floor((x - cx) / scale + 0.5 * columns),
            math.floor((cy - y) / (scale * _CELL_ASPECT) + 0.5 * rows),
        )

    return cell


def _extent(s: Snapshot) -> tuple[float, float, float, float]:
    """Bounds of what there is, widened to whole metres so that the view seldom jumps."""
    known = [p for p in (s.landmarks_xy_m, s.path_xy_m) if p is not None and len(p)]
    points = np.vstack([s.pose[None, :2], *known])
    points = points[np.all(np.isfinite(points), axis=1)]
    if not len(points):
        return -1.0, -1.0, 1.0, 1.0
    low, high = np.floor(points.min(axis=0) - _EXTENT_MARGIN_M), np.ceil(points.max(axis=0) + _EXTENT_MARGIN_M)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
