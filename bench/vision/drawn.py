"""Conditions drawn at random: ceilings, light, cameras and drives in combinations that nobody chose."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np

from ceilvo.bench.vision.condition import LAP, Condition, make
from ceilvo.bench.vision.conditions import HANGING, noisy
from ceilvo.bench.vision.textures import GLINT, POOL, reflecting
from ceilvo.calibration import Calibration
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.motion import LapSpec, TiltSpec
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.rig import simulated_calibration, simulated_camera
from ceilvo.sim.surroundings import scenes
from ceilvo.sim.surroundings.surroundings import SurroundingsSpec

_NAME = re.compile(r"drawn-(\d+)")
_SIZES = ((320, 240), (640, 480), (640, 480), (644, 482), (800, 600))
"""px; chosen: what cameras offer, 640x480 twice as often; larger ones take minutes to render and are looked at as these
are."""
_FPS = (10.0, 15.0, 20.0, 30.0, 30.0)
_TURNS_RADPS = 1.5
"""Fastest turn of the issue's bars."""
_USUAL_HIGH_M = simulated_calibration().ceiling_height_m
"""A ceiling further off is drawn as much more coarsely, for it takes memory."""
_SUB_POSES = 3
"""Of an exposure: fewer than elsewhere, because there are so many draws."""
_WORLDS = 1000
"""Seeds of worlds are so many times the bench's seed and on."""


def drawn(seed: int, number: int) -> Condition:
    """Condition `drawn-NUMBER` of a seed, in a world of its own. Every range is chosen: as wide as buildings are said
    to be, or as far as the bars go."""
    rng = np.random.default_rng([seed, number, 0xD2A3])
    high_m = float(rng.choice([1.3, 1.8, 2.2, 2.2, 3.0, 4.5]))
    pattern, ceiling = _ceiling(rng)
    ceiling = replace(ceiling, texel_m=ceiling.texel_m * max(high_m / _USUAL_HIGH_M, 1.0))
    around, surroundings = _surroundings(rng, high_m)
    lens, true = _camera(rng, high_m, ceiling)
    light, render = _light(rng)
    driving, lap, tilt = _driving(rng)
    fps = float(rng.choice(_FPS))
    about = f"{pattern}, {high_m:g} m up{around}; {lens}, {fps:g} Hz; {light}; {driving}"
    made = make(
        f"drawn-{number}",
        about,
        ceiling=ceiling,
        render=render,
        lap=lap,
        tilt=tilt,
        surroundings=surroundings,
        true=true,
        fps=fps,
    )
    return made.with_seed(_WORLDS * seed + number)


def named(name: str, seed: int) -> Condition | None:
    """The condition of that name; None for a name that is not one of these."""
    number = _NAME.fullmatch(name)
    return None if number is None else drawn(seed, int(number[1]))


def _ceiling(rng: np.random.Generator) -> tuple[str, CeilingSpec]:
    kind = str(rng.choice(["tiles", "tiles", "tiles", "oblong", "slats", "hexagons", "plaster"]))
    tile_m = float(rng.choice([0.3, 0.5, 0.6, 0.6, 0.625, 0.9, 1.25]))
    fields: dict[str, Any] = {
        "tile_m": tile_m,
        "grid_yaw_rad": float(rng.uniform(-0.25 * np.pi, 0.25 * np.pi)),
        "grid_offset_m": (float(rng.uniform(0.0, tile_m)), float(rng.uniform(0.0, tile_m))),
        "groove_m": float(np.exp(rng.uniform(np.log(0.003), np.log(0.025)))),
        "lip_m": float(rng.choice([0.0, 0.005])),
        "groove_soft_m": float(rng.choice([0.0, 0.0, 0.002])),
        "tile_spread": float(rng.choice([0.0, 0.025, 0.05])),
        "texture": float(rng.choice([0.0, 1.0, 3.0])),
        "fibre": float(rng.choice([0.0, 0.0, 0.5, 1.0])),
        "lamp_every": (int(rng.integers(2, 6)), int(rng.integers(2, 6))),
        "vents": int(rng.integers(0, 20)),
        "spots": int(rng.integers(0, 30)),
        "stains": int(rng.integers(0, 10)),
        "grilles": int(rng.choice([0, 0, 0, 8])),
    }
    said = f"{kind} of {tile_m:g} m"
    if kind == "oblong":
        fields["tile_y_m"] = 2.0 * tile_m
    if rng.random() < 0.5:
        depth = float(np.exp(rng.uniform(np.log(0.05), np.log(0.4)))) * float(rng.choice([-1.0, 1.0, 1.0]))
        fields["groove_darker"], said = depth, f"{said}, joints {100.0 * depth:+.0f} % darker"
    if kind == "slats":
        slat_m = float(rng.uniform(0.08, 0.2))
        fields |= {"pattern": "slats", "slat_m": slat_m, "lip_m": 0.0, "wood": bool(rng.random() < 0.5)}
        said = f"slats of {slat_m:.2f} m"
    if kind == "hexagons":
        fields["pattern"] = "hexagons"
    if kind == "plaster":
        fields["joints"], said = False, "plaster"
    hung = ["troffers", "troffers", "round lamps", "strip lamps", "no lamps"]
    lamps = str(rng.choice(hung[:-1] if kind in ("plaster", "slats") else hung))  # else the way is not to be seen
    if lamps == "no lamps":
        fields["lamp_every"] = (0, 0)
    fields |= {"round_lamps": lamps == "round lamps", "strip_lamps": lamps == "strip lamps"}
    return f"{said}, {lamps}", CeilingSpec(**fields)


def _surroundings(rng: np.random.Generator, high_m: float) -> tuple[str, SurroundingsSpec]:
    if rng.random() < 0.7 or high_m < 2.0:
        return "", SurroundingsSpec()
    name = str(rng.choice(list(HANGING)))
    return f", {name.replace('_', ' ')}", getattr(scenes, name)(LAP.room_m, high_m)


def _camera(rng: np.random.Generator, high_m: float, ceiling: CeilingSpec) -> tuple[str, Calibration]:
    kind: Any = str(rng.choice(["pinhole", "pinhole", "pinhole", "fisheye"]))
    width, height = _SIZES[int(rng.integers(len(_SIZES)))]
    if kind == "fisheye" and width < 640:
        width, height = 640, 480
    readout_s = float(rng.choice([0.0, 0.0, 0.01, 0.02]))
    lean = np.radians(rng.uniform(-8.0, 8.0, 2)) if rng.random() < 0.4 else np.zeros(2)
    true = simulated_calibration(
        simulated_camera(kind, width, height, readout_s=readout_s),
        yaw_rad=float(rng.uniform(-np.pi, np.pi)),
        roll_rad=float(lean[0]),
        pitch_rad=float(lean[1]),
        ceiling_height_m=high_m,
        tile_m=ceiling.tile_m if ceiling.tile_y_m is None and rng.random() < 0.5 else None,
    )
    leans = ", leans by " + " and ".join(f"{v:.0f}" for v in np.degrees(lean)) + " deg" if np.any(lean) else ""
    rolls = f", rows read in {1e3 * readout_s:.0f} ms" if readout_s else ""
    return f"{kind} {width}x{height}{leans}{rolls}", true


def _light(rng: np.random.Generator) -> tuple[str, RenderSpec]:
    base, said = RenderSpec(footprint=True), []
    gloss = float(rng.random())
    if gloss < 0.2:
        base = reflecting(*(GLINT if gloss < 0.1 else POOL))
        said.append("glints" if gloss < 0.1 else "pools of glow")
    noise = float(np.exp(rng.uniform(np.log(0.5), np.log(4.0))))
    exposure_s = float(rng.choice([0.0, 0.005, 0.015, 0.025]))
    spec = replace(
        noisy(noise, base),
        daylight=float(rng.uniform(0.12, 0.8)),
        lit=() if rng.random() < 0.15 else None,
        flicker_depth=float(rng.choice([0.0, 0.0, 0.3])),
        switch_groups=int(rng.choice([0, 0, 0, 0, 0, 3])),
        psf_px=float(rng.uniform(0.4, 1.2)),
        exposure_s=exposure_s,
        sub_poses=_SUB_POSES,
    )
    said += ["lamps off"] if spec.lit == () else []
    said += ["flicker"] if spec.flicker_depth else []
    said += ["switched"] if spec.switch_groups else []
    return ", ".join([f"noise x{noise:.1f}, {1e3 * exposure_s:.0f} ms", *said]), spec


def _driving(rng: np.random.Generator) -> tuple[str, LapSpec, TiltSpec]:
    speed_mps = float(rng.uniform(0.2, 1.2))
    radius_m = max(speed_mps / _TURNS_RADPS, float(rng.uniform(0.3, 0.8)))
    lap = replace(LAP, speed_mps=speed_mps, corner_radius_m=radius_m, rest_s=float(rng.choice([0.0, 0.5, 2.0])))
    deg = float(rng.choice([0.0, 0.0, 0.5, 2.0]))
    tilt = TiltSpec(float(np.radians(deg)), at_rest=bool(deg) and bool(rng.random() < 0.4))
    rocks = f", rocks by {deg:g} deg{' from the start' if tilt.at_rest else ''}" if deg else ""
    return f"{speed_mps:.2f} m/s{rocks}", lap, tilt
