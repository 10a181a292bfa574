"""What kind of ceiling is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from ceilvo.errors import ConfigError

Pattern = Literal["tiles", "hexagons", "slats"]


@dataclass(frozen=True)
class CeilingSpec:
    """A tiled office ceiling.

    Attributes:
        room_m: side of the room below it.
        margin_m: how far it goes on beyond the walls (open plan), so that the camera never sees its end.
        tile_m: side of a tile.
        grid_offset_m: where a groove of each axis lies, from the map's origin.
        grid_yaw_rad: the grid against the map, turned about the room's centre.
        groove_m, lip_m: width of the dark joint, and of the bright bevel on either side of it.
        groove_albedo, lip_albedo: how bright they are (a tile is 0.76). A wide bright joint is a T-bar, one of nearly
            the tile's brightness a faint groove.
        groove_darker: instead of both, how much darker a joint is than the tiles beside it, as a part of theirs; None
            keeps the albedos.
        joints: False is a bare plaster ceiling; what hangs on it stays where it was.
        pattern: what the joints make: squares, hexagons of tile_m from side to side, or slats slat_m wide along y.
        slat_m: pitch of the slats.
        round_lamps: discs instead of troffers; they have no straight edges and no corners.
        texel_m: resolution of the picture.
        tile_spread: standard deviation of the tiles' brightness.
        texture: strength of the tiles' speckle and mottling; 0 is plain.
        lamp_every: one lamp in so many tiles along each axis; (0, 0) is none.
        slope: by how much it rises in a metre of the map's x and y; the calibrated height is that of the room's centre.
        vents, spots, stains: how many of each in the room and its margin.
    """

    room_m: float = 5.0
    margin_m: float = 2.0
    tile_m: float = 0.6
    grid_offset_m: tuple[float, float] = (0.137, 0.418)
    grid_yaw_rad: float = 0.0
    groove_m: float = 0.008
    lip_m: float = 0.005
    groove_albedo: float = 0.16
    lip_albedo: float = 0.84
    groove_darker: float | None = None
    joints: bool = True
    pattern: Pattern = "tiles"
    slat_m: float = 0.1
    round_lamps: bool = False
    texel_m: float = 0.003
    tile_spread: float = 0.025
    texture: float = 1.0
    lamp_every: tuple[int, int] = (4, 3)
    slope: tuple[float, float] = (0.0, 0.0)
    vents: int = 12
    spots: int = 24
    stains: int = 7

    def __post_init__(self) -> None:
        for name in ("room_m", "tile_m", "groove_m", "slat_m", "texel_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"ceiling: {name} is {getattr(self, name)}, expected more than 0")
        if self.pattern not in get_args(Pattern):
            raise ConfigError(f"ceiling: pattern is {self.pattern!r}, expected one of {', '.join(get_args(Pattern))}")
        if self.groove_m + 2 * self.lip_m > 0.5 * self.tile_m:
            raise ConfigError(
                f"ceiling: groove_m {self.groove_m} with lip_m {self.lip_m} does not fit tiles of tile_m {self.tile_m}"
            )
