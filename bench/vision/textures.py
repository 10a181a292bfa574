"""Ceilings and lights as they are found, beyond tiles of one kind: worlds for the vision bench."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ceilvo.bench.data import data_path
from ceilvo.calibration import Calibration
from ceilvo.sim.ceiling.pictured import Picture
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.gloss import Gloss
from ceilvo.sim.renderer import RenderSpec
from ceilvo.sim.rig import simulated_calibration

_FOUND = RenderSpec(footprint=True)
FIBRE = CeilingSpec(fibre=1.0)
"""Tiles of fissured mineral fibre with shadow joints."""
FIBRE_BARS = CeilingSpec(fibre=1.0, groove_m=0.024, lip_m=0.0, groove_darker=-0.08, groove_soft_m=0.004)
"""The same between bars 24 mm wide, 8 % brighter than the tiles, with soft edges; chosen."""
SOFT_BARS = CeilingSpec(texture=0.0, fibre=0.05, groove_m=0.028, lip_m=0.0, groove_darker=0.15, groove_soft_m=0.004)
"""Bars 28 mm wide and 15 % darker than the tiles, as in the picture that board.CLOUDS_RMS is of; softer than there."""
OBLONG = CeilingSpec(fibre=0.5, tile_m=0.6, tile_y_m=1.2)
BOARDS = CeilingSpec(fibre=0.2, tile_m=0.3, tile_y_m=4.0, lamp_every=(0, 0), vents=0, spots=0, stains=0)
"""Long boards, as of corridors: joints of one direction, and every 4 m one across."""
GRILLES = CeilingSpec(grilles=14, vents=24)
STRIPS = CeilingSpec(strip_lamps=True, tile_m=0.6, tile_y_m=1.2, lamp_every=(1, 2), fibre=0.5)
STRIPS_ONLY = CeilingSpec(strip_lamps=True, joints=False, lamp_every=(1, 3), vents=0, stains=0, tile_spread=0.0)
WOOD = CeilingSpec(pattern="slats", slat_m=0.12, groove_m=0.02, lip_m=0.0, wood=True, texture=0.0, tile_spread=0.0)
OPEN_CELLS = CeilingSpec(tile_m=0.1, groove_m=0.012, lip_m=0.0, lamp_every=(18, 12), vents=0, stains=0)
"""Cells a sixth as wide as tiles: a thousand crossings in view, and a period of a few frames' way."""
HEXAGONS = CeilingSpec(pattern="hexagons", tile_m=0.5)
PLASTER = CeilingSpec(joints=False, vents=0, spots=0, stains=3, tile_spread=0.0)
"""Nothing but lamps and a few stains; chosen."""
PICTURED, OFFICE_TEXTURE = "office-texture", "textures/OfficeCeiling006_4K_color.png"
"""ambientCG, CC0: 16 by 16 tiles with joints 11 of 256 px wide and 6.5 % darker, every fourth tile a dark panel."""
TWO_LAMPS = CeilingSpec(joints=False, vents=0, spots=0, stains=0, tile_spread=0.0, texture=0.0, lamp_every=(4, 3))
_LIGHTS_EVERY_M, _LIGHTS_BELOW_M, _ROOM_M = 1.7, 1.4, 6.94
"""Lights that a glossy ceiling shows: how far apart, how far below it, and up to where; chosen, as desk lamps stand."""
GLINT, POOL = (0.015, 4.0), (0.25, 0.35)
"""Size on the ceiling (sigma) and radiance of a glint, which saturates, and of a pool of glow; chosen."""


@dataclass(frozen=True)
class Found:
    """A ceiling of the bench: what it is called, what it is, and what makes it."""

    name: str
    about: str
    ceiling: CeilingSpec = field(default_factory=CeilingSpec)
    render: RenderSpec = _FOUND
    true: Calibration = field(default_factory=simulated_calibration)


def found_ceilings() -> tuple[Found, ...]:
    """All of them, in the order of the table."""
    askew = simulated_calibration(pitch_rad=float(np.radians(24.0)))
    return (
        Found("fibre", "fissured mineral fibre, joints of 8 mm", FIBRE),
        Found("fibre-bars", "the same between soft bars 24 mm wide, 8 % brighter", FIBRE_BARS),
        Found("soft-bars", "plain boards between soft bars 28 mm wide, 15 % darker", SOFT_BARS),
        Found("oblong", "tiles of 0.6 x 1.2 m", OBLONG),
        Found("boards", "boards of 0.3 x 4 m: one direction, and now and then a joint across", BOARDS),
        Found("grilles", "14 grilles of 50 mm cells, 24 vents and diffusers", GRILLES),
        Found("strips", "rows of strip lamps under tiles of 0.6 x 1.2 m", STRIPS),
        Found("strips-only", "rows of strip lamps and sprinklers on plaster", STRIPS_ONLY),
        Found("wood-slats", "slats of wood, each its own", WOOD),
        Found("open-cells", "open cells of 0.1 m, a thousand crossings in view", OPEN_CELLS),
        Found("two-lamps", "plaster, about two lamps in view", TWO_LAMPS),
        Found("hexagons", "hexagons of 0.5 m with troffers", HEXAGONS),
        Found("hexagons-round", "hexagons of 0.5 m with round lamps", replace(HEXAGONS, round_lamps=True)),
        Found("slats-round", "slats of wood with round lamps", replace(WOOD, round_lamps=True)),
        Found("plaster-round", "plaster with round lamps, one to four in view", replace(PLASTER, round_lamps=True)),
        Found("plaster-glints", "plaster with troffers, and glints that slide", PLASTER, reflecting(*GLINT)),
        Found("pools", "pools of glow that slide with the robot", render=reflecting(*POOL)),
        Found("glints", "glints that pass for lamps and slide", render=reflecting(*GLINT)),
        Found("off-24-deg", "camera mounted 24 deg off the vertical", true=askew),
        *_pictured(data_path(OFFICE_TEXTURE)),
    )


def _pictured(path: Path) -> list[Found]:
    """Somebody else's picture of a ceiling, where it is there."""
    if not path.is_file():
        return []
    bare = CeilingSpec(lamp_every=(0, 0), vents=0, spots=0, stains=0, grid_offset_m=(0.0, 0.0), lip_m=0.0)
    joints = replace(bare, groove_m=11.0 / 256.0 * bare.tile_m, groove_darker=0.065)
    ceiling = replace(joints, picture=Picture(path, tiles=16, dark_every=4, dark_first=3, dark_inset=12.0 / 256.0))
    return [Found(PICTURED, "a picture of a ceiling that nobody here drew", ceiling)]


def reflecting(sigma_m: float, radiance: float) -> RenderSpec:
    """Lights all over the room, and one on the robot."""
    at = np.arange(0.5, _ROOM_M, _LIGHTS_EVERY_M)
    lights = [Gloss((float(x), float(y)), _LIGHTS_BELOW_M, sigma_m, radiance) for x in at for y in at]
    carried = Gloss((0.3, 0.5), _LIGHTS_BELOW_M, sigma_m, radiance, carried=True)
    return RenderSpec(footprint=True, gloss=(*lights, carried))
