"""Draws mounting.svg, axes.svg, wiring.svg and steps.svg beside itself: `python docs/images/setup.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ceilvo.calib.record.drawing import GREY, INK, PALE, SERIES, Drawing

HERE = Path(__file__).parent
BLUE, RED, GREEN, _ = SERIES
LIGHT = "#cfe3f1"


def arrow(
    d: Drawing, start: tuple[float, float], end: tuple[float, float], colour: str = INK, width: float = 2.0
) -> None:
    a, b = np.array(start), np.array(end)
    along = (b - a) / np.linalg.norm(b - a)
    across = np.array([-along[1], along[0]])
    d.line((a, b - 6 * along), colour, width)
    d.line((b, b - 11 * along + 4.5 * across, b - 11 * along - 4.5 * across), colour, 1.0, fill=colour)


def both_ways(d: Drawing, start: tuple[float, float], end: tuple[float, float], colour: str = GREY) -> None:
    middle = (0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1]))
    arrow(d, middle, start, colour, 1.2)
    arrow(d, middle, end, colour, 1.2)


def box(d: Drawing, x: float, y: float, width: float, lines: tuple[str, ...], fill: str = "#f2f2f2") -> None:
    """A box of words, the first of them larger."""
    height = 16.0 * len(lines) + 14.0
    d.rect(x, y, width, height, fill, GREY)
    for k, words in enumerate(lines):
        d.text(
            x + width / 2,
            y + 20 + 16 * k,
            words,
            anchor="middle",
            size=11 if k else 13,
            colour=INK if not k else "#444444",
        )


def mounting() -> Drawing:
    """From the side: what the camera sees, and what hides it."""
    d = Drawing(680, 380)
    d.rect(30, 30, 620, 12, PALE, GREY)
    for x in range(30, 651, 62):
        d.line(((x, 30), (x, 42)), GREY, 1.5)
    d.text(40, 22, "tiled ceiling: joints, lamps and vents are what it steers by", size=12)
    d.line(((340, 262), (118, 42), (562, 42)), "none", 0.0, fill=LIGHT)
    d.line(((340, 262), (340, 42)), BLUE, 1.2, dash="6 4")
    d.text(348, 120, "optical axis: about straight up;", size=11, colour=BLUE)
    d.text(348, 135, "calib measures what is left", size=11, colour=BLUE)
    d.rect(230, 300, 220, 46, "#e4e4e4", INK)
    d.text(340, 328, "robot", anchor="middle")
    for x in (270, 410):
        d.dots((x, 350), INK, 14)
        d.dots((x, 350), "#ffffff", 6)
    d.rect(334, 274, 12, 26, GREY)
    d.rect(326, 262, 28, 14, INK)
    d.text(362, 274, "camera, stiff on the frame:", size=11)
    d.text(362, 288, "what turns or rocks against the wheels is an error", size=11)
    both_ways(d, (600, 262), (600, 44))
    d.line(((360, 262), (612, 262)), PALE, 1.0)
    d.text(592, 170, "height, lens to ceiling", anchor="middle", size=11, up=True)
    both_ways(d, (118, 58), (562, 58), BLUE)
    d.text(200, 76, "seen: the more, the better", anchor="middle", size=11, colour=BLUE)
    d.rect(146, 196, 14, 150, "#f4d9c6", RED)
    d.text(22, 214, "nothing in the", size=11, colour=RED)
    d.text(22, 229, "field of view:", size=11, colour=RED)
    d.text(22, 244, "mast, load, lamp", size=11, colour=RED)
    return d


def axes() -> Drawing:
    """From above: the base's axes, the camera's place and its picture."""
    d = Drawing(680, 380)
    d.line(((140, 90), (140, 300), (300, 300), (300, 90), (220, 55)), INK, 1.5, fill="#f2f2f2")
    for x in (128, 300):
        d.rect(x, 190, 12, 40, INK)
    origin = (220.0, 210.0)
    arrow(d, origin, (220, 20), RED, 2.5)
    d.text(230, 30, "x, forward", colour=RED)
    arrow(d, origin, (60, 210), GREEN, 2.5)
    d.text(40, 200, "y, left", colour=GREEN)
    d.dots(origin, INK, 5)
    d.text(220, 318, "base: the centre of rotation, between the driven wheels", anchor="middle", size=11)
    d.line(((220, 216), (220, 306)), GREY, 1.0, dash="2 3")
    turn = np.radians(np.linspace(-90, -165, 20))
    d.line(np.array(origin) + 150 * np.column_stack([np.cos(turn), np.sin(turn)]), GREY, 1.5)
    for k, words in enumerate(("theta:", "to the left", "positive")):
        d.text(14, 100 + 15 * k, words, size=11, colour="#444444")
    camera = (190.0, 130.0)
    d.dots(camera, BLUE, 7)
    d.line((camera, (220, 130)), BLUE, 1.2, dash="4 3")
    d.line((camera, (190, 210)), BLUE, 1.2, dash="4 3")
    d.text(150, 175, "+0.08", size=11, colour=BLUE)
    d.text(190, 118, "+0.03", size=11, colour=BLUE)
    d.text(148, 108, "camera", size=12, colour=BLUE)
    d.text(30, 345, "offset of the camera, by calib mount: metres forward, metres left", size=12, colour=BLUE)
    d.rect(400, 80, 240, 180, LIGHT, GREY)
    d.text(520, 68, "its picture, looking up at the ceiling", anchor="middle")
    arrow(d, (410, 90), (500, 90), RED, 2.0)
    d.text(506, 95, "u: along x at yaw 0", size=11, colour=RED)
    arrow(d, (410, 90), (410, 160), GREEN, 2.0)
    d.text(418, 165, "v: along y", size=11, colour=GREEN)
    d.line(((512, 170), (528, 170)), INK, 1.5)
    d.line(((520, 162), (520, 178)), INK, 1.5)
    d.text(520, 196, "principal point: the ceiling above the camera", anchor="middle", size=11)
    d.text(400, 285, "yaw: how the picture is turned against the robot.", size=11)
    d.text(400, 301, "Any yaw will do; calib mount measures it.", size=11)
    return d


def wiring() -> Drawing:
    """What is connected to what."""
    d = Drawing(680, 330)
    box(d, 20, 30, 150, ("camera", "USB, global shutter best", "stable name in /dev/v4l/by-id"))
    box(
        d,
        265,
        60,
        160,
        ("computer", "ceilvod", "/etc/ceilvo/config.yaml", "/etc/ceilvo/calibration.yaml", "/var/lib/ceilvo: map"),
        LIGHT,
    )
    box(d, 20, 200, 150, ("base controller", "Modbus RTU, 115200 8E1", "slave; ceilvo is the master"))
    box(d, 510, 30, 150, ("your programs", "Zenoh, this computer;", "others: TLS and token"))
    box(d, 510, 200, 150, ("browser", "ceilvod web", "http://127.0.0.1:8480"))
    arrow(d, (170, 62), (264, 90), BLUE)
    d.text(176, 60, "frames, 30 Hz", size=11, colour=BLUE)
    arrow(d, (265, 140), (172, 206), BLUE)
    arrow(d, (160, 198), (264, 122), GREEN)
    d.text(30, 185, "USB to RS-485", size=11)
    d.text(232, 190, "pose, state", size=11, colour=BLUE)
    d.text(160, 150, "wheels", size=11, colour=GREEN)
    arrow(d, (425, 90), (508, 62), BLUE)
    d.text(418, 50, "poses, events", size=11, colour=BLUE)
    arrow(d, (425, 140), (508, 206), BLUE)
    d.text(470, 160, "live page", size=11, colour=BLUE)
    d.line(((60, 275), (60, 300), (110, 300)), GREY, 1.5)
    d.text(118, 304, "RS-485: A to A, B to B, ground to ground, 120 ohm at both ends of the line", size=11)
    return d


def steps() -> Drawing:
    """The way from a box to a robot that localises itself."""
    d = Drawing(680, 300)
    parts = (
        ("intrinsics", "hold a board", "everywhere: the lens"),
        ("projection", "10 to 20 places", "under tiles: tilt, height"),
        ("mount", "turn four times, drive", "2 m: place on the robot"),
        ("sigma", "stand in 12 to 20", "places: the noise"),
        ("survey", "drive through the", "room: enough to see?"),
        ("check", "a dozen pictures:", "still good?"),
        ("report", "page and PDF", "for the customer"),
    )
    for k, (name, *lines) in enumerate(parts):
        row, column = divmod(k, 4)
        x, y = 15 + 167 * column, 30 + 110 * row
        box(d, x, y, 148, (f"{k + 1}. calib {name}", *lines), LIGHT if k < 4 else "#f2f2f2")
        if column < 3 and k < len(parts) - 1:
            arrow(d, (x + 149, y + 31), (x + 166, y + 31))
    d.line(((590, 92), (590, 116), (89, 116)), INK, 2.0)
    arrow(d, (89, 116), (89, 138))
    d.text(15, 20, "blue steps make calibration.yaml", size=11, colour=BLUE)
    arrow(d, (498, 171), (516, 171))
    box(d, 517, 140, 148, ("ceilvod", "config.yaml and", "calibration.yaml: TRACKING"), "#d9efe6")
    d.text(
        15,
        250,
        "Each step says PASS, or FAIL with what to do; Ctrl-C loses nothing, the same command goes on.",
        size=12,
    )
    d.text(15, 270, "Practise first, without hardware: every step takes --simulate.", size=12)
    return d


DRAWN = {"mounting": mounting, "axes": axes, "wiring": wiring, "steps": steps}

if __name__ == "__main__":
    for name, draw in DRAWN.items():
        (HERE / f"{name}.svg").write_text(draw().svg(), encoding="utf-8")
