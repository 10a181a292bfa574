"""What kind of ceiling is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from ceilvo.errors import ConfigError
from ceilvo.sim.ceiling.pictured import Picture

Pattern = Literal["tiles", "hexagons", "slats"]


@dataclass(frozen=True)
class CeilingSpec:
    """A tiled office ceiling.

    Attributes:
        room_m: side of the room below it.
        margin_m: how far it goes on beyond the walls (open plan), so that the camera never sees its end.
        tile_m: side of a tile.
        tile_y_m: its other side, along y; None is a square.
        grid_offset_m: where a groove of each axis lies, from the map's origin.
        grid_yaw_rad: the grid against the map, turned about the room's centre.
        groove_m, lip_m: width of the dark joint, and of the bright bevel on either side of it.
        groove_albedo, lip_albedo: how bright they are (a tile is 0.76). A wide bright joint is a T-bar, one of nearly
            the tile's brightness a faint groove.
        groove_darker: instead of both, how much darker a joint is than the tiles beside it, as a part of theirs; below
            0 it is brighter; None keeps the albedos.
        groove_soft_m: standard deviation of a blur of the joints' edges: paint, round edges, shadows without a border.
        joints: False is a bare plaster ceiling; what hangs on it stays where it was.
        pattern: what the joints make: squares, hexagons of tile_m from side to side, or slats slat_m wide along y.
        slat_m: pitch of the slats.
        round_lamps: discs instead of troffers; they have no straight edges and no corners.
        strip_lamps: instead, lamps end to end along x in every lamp_every[1]-th row of tiles.
        texel_m: resolution of the picture.
        tile_spread: standard deviation of the tiles' brightness.
        texture: strength of the tiles' speckle and mottling; 0 is plain.
        fibre: instead of texture, pinholes, fissures and clouds of mineral-fibre board (ceiling/board.py); 1 is as many
            as a fissured board has, 0 none.
        wood: slats of wood, each of its own brightness and grain.
        lamp_every: one lamp in so many tiles along each axis; (0, 0) is none.
        slope: by how much it rises in a metre of the map's x and y; the calibrated height is that of the room's centre.
        picture: the ceiling is this, with its tiles as large as tile_m, and nothing is drawn; grid_offset_m is 0, and
            groove_m and groove_darker say what its joints are.
        vents, spots, stains, grilles: how many of each in the room and its margin; a grille is two tiles long.
    """

    room_m: float = 5.0
    margin_m: float = 2.0
    tile_m: float = 0.6
    tile_y_m: float | None = None
    grid_offset_m: tuple[float, float] = (0.137, 0.418)
    grid_yaw_rad: float = 0.0
    groove_m: float = 0.008
    lip_m: float = 0.005
    groove_albedo: float = 0.16
    lip_albedo: float = 0.84
    groove_darker: float | None = None
    groove_soft_m: float = 0.0
    joints: bool = True
    pattern: Pattern = "tiles"
    slat_m: float = 0.1
    round_lamps: bool = False
    strip_lamps: bool = False
    texel_m: float = 0.003
    tile_spread: float = 0.025
    texture: float = 1.0
    fibre: float = 0.0
    wood: bool = False
    lamp_every: tuple[int, int] = (4, 3)
    slope: tuple[float, float] = (0.0, 0.0)
    vents: int = 12
    spots: int = 24
    stains: int = 7
    grilles: int = 0
    picture: Picture | None = None

    def __post_init__(self) -> None:
        for name in ("room_m", "tile_m", "groove_m", "slat_m", "texel_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"ceiling: {name} is {getattr(self, name)}, expected more than 0")
        if self.tile_y_m is not None and not self.tile_y_m > 0:
            raise ConfigError(f"ceiling: tile_y_m is {self.tile_y_m}, expected more than 0")
        if self.picture is not None and (self.grid_offset_m != (0.0, 0.0) or self.tile_y_m is not None):
            raise ConfigError(
                f"ceiling: a picture with grid_offset_m {self.grid_offset_m} and tile_y_m {self.tile_y_m}, expected "
                "(0, 0) and none"
            )
        if self.pattern not in get_args(Pattern):
            raise ConfigError(f"ceiling: pattern is {self.pattern!r}, expected one of {', '.join(get_args(Pattern))}")
        if self.groove_m + 2 * self.lip_m > 0.5 * min(self.tile_xy_m):
            raise ConfigError(
                f"ceiling: groove_m {self.groove_m} with lip_m {self.lip_m} does not fit tiles of "
                f"{self.tile_xy_m[0]} x {self.tile_xy_m[1]} m"
            )

    @property
    def tile_xy_m(self) -> tuple[float, float]:
        """Sides of a tile along x and y."""
        return self.tile_m, self.tile_m if self.tile_y_m is None else self.tile_y_m
