"""A ceiling that is a picture: somebody else's drawing in place of ours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.errors import FileFormatError

Array32 = NDArray[np.float32]


@dataclass(frozen=True)
class Picture:
    """A picture that continues itself beyond its sides, as tiles x tiles tiles, with joints along its sides.

    Attributes:
        path: of the file.
        tiles: along each side.
        dark_every, dark_first: every so manieth tile along both axes, from that one on, is a dark panel.
        dark_inset: how far from the middles of the joints around it that begins, as a part of a tile.
    """

    path: Path
    tiles: int
    dark_every: int
    dark_first: int
    dark_inset: float

    def is_dark(self, column: int, row: int) -> bool:
        """Whether a tile is a panel; column, row: counted from the picture's corner, below 0 as well."""
        return column % self.dark_every == row % self.dark_every == self.dark_first


def albedo_of(
    picture: Picture, tile_m: float, low_m: tuple[float, float], size: tuple[int, int], texel_m: float, white: float
) -> Array32:
    """(H, W) of size (W, H) texels, the picture's corner at 0, its brightest grey as bright as white paint.

    Greys are taken as they are coded, without the curve of sRGB: dark parts are brighter than what was photographed.

    Args:
        tile_m: side of a tile.
        low_m: (2,) where the first texel begins.

    Raises:
        FileFormatError: it is no picture.
    """
    grey = cv2.imread(str(picture.path), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        raise FileFormatError(f"{picture.path}: cannot be read as a picture, expected a PNG or JPEG of a ceiling")
    side_m = picture.tiles * tile_m
    texels = max(round(side_m / texel_m), 1)
    shrunk = cv2.resize(grey, (texels, texels), interpolation=cv2.INTER_AREA).astype(np.float32)
    x, y = (
        ((low + (np.arange(n) + 0.5) * texel_m) * (texels / side_m) - 0.5).astype(np.float32)
        for low, n in zip(low_m, size, strict=True)
    )
    at_x, at_y = np.meshgrid(x, y)
    drawn = cv2.remap(shrunk, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    return np.asarray(drawn * np.float32(white / max(float(np.max(shrunk)), 1.0)), np.float32)
