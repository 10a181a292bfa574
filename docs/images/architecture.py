"""Draws docs/images/floors.svg and walk.svg: .venv/bin/python docs/images/architecture.py [--png]

What a room imports is read from the sources, so draw the floors again when that changes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests" / "common"))
import house  # noqa: E402

PURE, IMPURE, SHARED, OUTSIDE, LINE = "#d8ecd8", "#fbe3c8", "#dce6f5", "#ececec", "#444444"
SAID = {
    "cli": "ceilvod and its words",
    "start": "the command as installed",
    "building": "maps of buildings from many drives: refined, joined, built",
    "editing": "ceilvod map: looking at maps, editing, undoing",
    "fleet": "maps that a fleet shares: the service, a robot's side",
    "shelf": "maps beside the one in use, taken at a start",
    "refinement": "a map made better from all that was seen",
    "doctor": "what is wrong with this installation?",
    "app": "process, estimator thread, outputs, requests, screen",
    "replay": "inputs, snapshot, recording, replay, trajectory, overlay",
    "pipeline": "the method as one page: Pipeline.step",
    "integrity": "may this pose be used? states, stale calibration",
    "relocalisation": "which place on the map; the filter that finds itself again",
    "slam/paper": "the other filters: paper's letter, FastSLAM, UKF",
    "slam": "motion and crossings to belief: default filter, schedule",
    "odometry": "crossings to motion; dead reckoning",
    "vision": "frame to lines to crossings; kernel/",
}
STAGES = (
    ("vision", "frame → lines → crossings", "LineFinderState"),
    ("odometry", "crossings → motion", "VisualOdometryState"),
    ("dead_reckoning", "motion → track: final, or gap", "DeadReckoningState"),
    ("schedule", "is this view news?", "ScheduleState"),
    ("relocaliser", "what may a view teach? which place?", "RelocaliserState"),
    ("filter", "belief: pose and map", "RecoveringState"),
    ("states", "may the pose be used?", "StateMachineState"),
)
CALLS = (
    (1, "expected: how far since the last frame", False),
    (0, "crossings", True),
    (1, "step: motion", False),
    (2, "advance: track", False),
    (3, "travelled", False),
    (4, "travelled: a blind path is a doubt", False),
    (5, "predict, when the track is final", False),
    (3, "due?", True),
    (4, "see, admit", False),
    (5, "update with what is admitted", False),
    (4, "weigh the hypothesis, if there is one", True),
    (5, "estimate", False),
    (6, "step: state, quality, reason", False),
)
"""Calls of Pipeline.step that do work, in order: stage, what, whether the walk goes back for it."""
CAPTION = (
    "From top to bottom: one frame with an update. Red: the walk goes back. "
    "Italic: what the stage remembers (filter: the default one)."
)
TOWERS = (
    (
        7.95,
        1.5,
        "app",
        IMPURE,
        "daemon/map",
        "map and last\npose on disk\n\nimported by app,\nbuilding, doctor,\nfleet, editing,\nrefinement",
    ),
    (
        9.55,
        1.55,
        "replay",
        IMPURE,
        "drivers",
        "camera/, base/,\nbus/, recording/,\nhost/, ports.py\n\nby replay, fleet,\napp, doctor; sim,\ncalib, bench",
    ),
    (
        11.2,
        1.6,
        "app",
        OUTSIDE,
        "sim",
        "ceiling, robot, base;\nimports drivers\n\nimported by\napp/simulation.py,\ncalib, bench, tests",
    ),
)
"""Beside the floors: x, width, floor above, colour, name, text."""
CALIB = "commissioning: commands/, solve/, targets/, session/, ...\nmay import all but bench; nobody imports it"
BENCH = "studies: paper/, mrclam/, vision/, faults/, fleet/, ...\nmay import all but calib; nobody imports it"


def box(ax: Axes, at: tuple[float, float, float, float], colour: str, name: str = "", text: str = "") -> None:
    x, y, width, height = at
    shape = FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=0.08", fc=colour, ec=LINE, lw=0.8)
    ax.add_patch(shape)
    if name:
        ax.text(x + 0.12, y + height - 0.1, name, va="top", fontsize=11, fontweight="bold")
    ax.text(x + 0.12, y + height - 0.42, text, va="top", fontsize=8.5)


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height))
    ax = figure.add_axes((0, 0, 1, 1))
    ax.set_xlim(0, width)
    ax.set_ylim(0, height)
    ax.axis("off")
    return figure, ax


def used(rooms: dict[str, set[str]], floor: str) -> str:
    """The other rooms of daemon/ that a floor imports, from the top down."""
    mine = {r for r in rooms if r.startswith("daemon/") and house.floor_of(r) == house.FLOORS.index(floor)}
    others = {house.floor_of(r): r for room in mine for r in rooms[room] - mine if r.startswith("daemon/")}
    floors_used = sorted((f for f in others if f is not None), reverse=True)
    names = [house.FLOORS[f] for f in floors_used] + (["map"] if None in others else [])
    return f"imports {', '.join(names)}" if names else "imports no other room"


def floors() -> Figure:
    rooms = house.read().rooms
    ground, step, wide = 0.98, 0.82, 7.0
    tower = [f for f in house.FLOORS if f != "ceilvo"]
    y_of = {floor: ground + step * level for level, floor in enumerate(tower)}
    top = ground + step * len(tower)
    figure, ax = canvas(13.0, top + 1.15)
    box(
        ax,
        (0.2, 0.2, 12.6, 0.7),
        SHARED,
        "ceilvo",
        "types, geometry, camera model, calibration, config/; all may import it",
    )
    for floor, y in y_of.items():
        colour = PURE if y <= y_of["pipeline"] else IMPURE
        box(ax, (0.2, y, wide, step - 0.08), colour, f"daemon/{floor}", SAID[floor])
        ax.text(0.08 + wide, y + 0.64, used(rooms, floor), fontsize=8, ha="right", va="top")
    y = y_of["replay"] - 0.04
    ax.plot((0.1, 7.3), (y, y), color="#a04000", lw=1.6, ls="--")
    ax.text(7.32, y - 0.08, "below:\npure", color="#a04000", fontsize=9, va="top")
    for x, width, under, colour, name, text in TOWERS:
        box(ax, (x, ground, width, y_of[under] - ground - 0.08), colour, name, text)
    box(ax, (0.2, top + 0.15, 6.2, 0.85), OUTSIDE, "calib", CALIB)
    box(ax, (6.6, top + 0.15, 6.2, 0.85), OUTSIDE, "bench", BENCH)
    return figure


def walk() -> Figure:
    lane, row, left = 1.78, 0.5, 0.2
    bottom = 0.55
    height = bottom + row * len(CALLS) + 1.45
    figure, ax = canvas(left * 2 + lane * len(STAGES), height)
    for i, (name, does, state) in enumerate(STAGES):
        x = left + lane * i
        box(ax, (x + 0.04, height - 1.25, lane - 0.08, 1.1), PURE, name)
        ax.text(x + 0.16, height - 0.56, wrapped(does), fontsize=8, va="top")
        ax.text(x + 0.16, height - 1.2, state, fontsize=8, va="bottom", color="#205080", style="italic")
        ax.plot((x + lane / 2,) * 2, (bottom, height - 1.25), color="#bbbbbb", lw=0.8, zorder=0)
    before: tuple[float, float] | None = None
    for k, (stage, text, back) in enumerate(CALLS):
        x, y = left + lane * (stage + 0.5), height - 1.6 - row * k
        colour = "#b03020" if back else LINE
        if before is not None:
            arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.2, "shrinkA": 5, "shrinkB": 5}
            ax.annotate("", (x, y), before, arrowprops=arrow)
        ax.plot(x, y, "o", color=colour, ms=6)
        aside, side = (-0.13, "right") if back or stage == len(STAGES) - 1 else (0.13, "left")
        level = y - 0.06 if side == "right" and not back else y + 0.06
        ax.text(x + aside, level, text, fontsize=9, va="top" if level < y else "bottom", ha=side, color=colour)
        before = x, y
    ax.text(left, 0.15, CAPTION, fontsize=9)
    return figure


def wrapped(text: str, width: int = 21) -> str:
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] += f"{word} "
    return "\n".join(lines)


def main() -> int:
    mpl.rcParams.update({"svg.hashsalt": "ceilvo", "font.family": "DejaVu Sans"})
    kinds = ["svg", "png"] if "--png" in sys.argv else ["svg"]
    for name, figure in (("floors", floors()), ("walk", walk())):
        for kind in kinds:
            folder = Path(__file__).parent if kind == "svg" else ROOT / "build"
            figure.savefig(folder / f"{name}.{kind}", dpi=90, metadata={"Date": None} if kind == "svg" else None)
    return 0


if __name__ == "__main__":
    sys.exit(main())
