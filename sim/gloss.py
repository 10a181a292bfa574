"""Lights that a glossy ceiling reflects: glints, and pools of glow where it is matt enough to smear them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceilvo.errors import ConfigError

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

_REACH_SIGMAS = 4.0
"""Beyond this a pool is dark: below 0.04 % of its middle."""


@dataclass(frozen=True)
class Gloss:
    """A light below the ceiling and its mirror image in it.

    The camera sees the image at one place of the ceiling, between itself and the light as a mirror has it. So when the
    robot drives, the image slides over the ceiling with a part of the robot's speed.

    Attributes:
        xy_m: where the light is, in map; with `carried`, from the camera, along map's axes.
        below_m: how far below the ceiling.
        sigma_m: standard deviation of the image on the ceiling: a cm or two is a glint, decimetres a pool.
        radiance: of its middle; a white surface in full light is 1.
        carried: the light goes with the robot, and its image as fast.
    """

    xy_m: tuple[float, float]
    below_m: float
    sigma_m: float
    radiance: float
    carried: bool = False

    def __post_init__(self) -> None:
        for name in ("below_m", "sigma_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"gloss: {name} is {getattr(self, name)}, expected more than 0")

    def image_m(self, camera_m: Array, height_m: float) -> Array:
        """(2,) place on the ceiling, in map, where a camera (2,) so far below it sees the light."""
        light = np.array(self.xy_m) + (camera_m if self.carried else 0.0)
        return np.asarray(camera_m + (light - camera_m) * height_m / (height_m + self.below_m))


def add_gloss(
    gloss: tuple[Gloss, ...],
    camera_m: Array,
    height_m: float,
    texels: tuple[Array, float],
    at: Array32,
    out: Array32,
) -> None:
    """Adds each image's radiance to a picture.

    Args:
        texels: (3, 3) texture coordinates from map, and a texel's side in metres.
        at: (H, W, 2) texture coordinates that the pixels see.
        out: (H, W) radiance, changed.
    """
    texel_from_map, texel_m = texels
    for g in gloss:
        u, v, _ = texel_from_map @ np.array([*g.image_m(camera_m, height_m), 1.0])
        sigma = g.sigma_m / texel_m
        off2 = (at[..., 0] - np.float32(u)) ** 2 + (at[..., 1] - np.float32(v)) ** 2
        near = off2 < (_REACH_SIGMAS * sigma) ** 2
        out[near] += np.float32(g.radiance) * np.exp(off2[near] * np.float32(-0.5 / sigma**2))
