"""A flat picture somewhere in space, and how its body is painted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]

TEXEL_M = 0.004
"""Of the surfaces' pictures: chosen, a pixel on the ceiling is 5 mm."""
_BORDER = 8
"""Empty texels around a picture, so that its edge is soft."""
_MOTTLE, _MOTTLE_TEXELS, _SOFT_TEXELS = 0.02, 20, 0.7
"""Relative mottling, over so many texels, and the blur of a surface's edge; chosen."""


@dataclass(frozen=True)
class Surface:
    """A flat picture in space.

    Attributes:
        picture: (H, W, 2) radiance times alpha, and alpha; transparent at its border.
        origin: (3,) x, y in its frame and height above the camera, of the middle of texel [0, 0].
        u, v: (3,) unit vectors along columns and rows, perpendicular.
        texel_m: spacing of the texels.
        frame: "map" hangs in the room, "base" goes with the robot.
        solid: it is drawn where nothing nearer was drawn before it; others are drawn over what came before.
    """

    picture: Array32
    origin: Array
    u: Array
    v: Array
    texel_m: float
    frame: Literal["map", "base"] = "map"
    solid: bool = False

    def texel_from_ray(self, frame_from_base: Array, mount_xy_m: Array) -> Array:
        """(3, 3) homography from rays (x / z, y / z, 1) in level base to texels; the camera is at height 0."""
        rot, off = self._seen_from(frame_from_base, mount_xy_m)
        n = np.cross(self.u, self.v)
        # off + s ray lies in the plane for s = -(n off) / (n ray)
        rows = [(axis @ off) * n - (n @ off) * axis for axis in (self.u, self.v)]
        return np.asarray(np.stack([rows[0] / self.texel_m, rows[1] / self.texel_m, n]) @ rot, np.float64)

    def distance(self, frame_from_base: Array, mount_xy_m: Array) -> float:
        """Of the plane along its normal; over the homography's third row times a ray it is how many rays away it is."""
        return -float(np.cross(self.u, self.v) @ self._seen_from(frame_from_base, mount_xy_m)[1])

    def _seen_from(self, frame_from_base: Array, mount_xy_m: Array) -> tuple[Array, Array]:
        """(3, 3) frame_from_base, and (3,) from the origin to the camera."""
        rot = np.eye(3)
        x, y, theta = (0.0, 0.0, 0.0) if self.frame == "base" else frame_from_base
        c, s = np.cos(theta), np.sin(theta)
        rot[:2, :2] = [[c, -s], [s, c]]
        return rot, np.array([x, y, 0.0]) + rot @ np.array([*mount_xy_m, 0.0]) - self.origin


def mottled(albedo: float, h: int, w: int, rng: np.random.Generator) -> Array32:
    """(h, w) a body of an albedo, not quite even."""
    coarse = rng.standard_normal((h // _MOTTLE_TEXELS + 2, w // _MOTTLE_TEXELS + 2), dtype=np.float32)
    spread = cv2.resize(coarse, (w, h), interpolation=cv2.INTER_CUBIC)
    return np.asarray(albedo * (1.0 + _MOTTLE * spread), np.float32)


def surface(
    body: Array32, corner: Array, u: Array, v: Array, frame: Literal["map", "base"] = "map", solid: bool = False
) -> Surface:
    """With a soft edge.

    Args:
        body: (h, w) radiance.
        corner: (3,) middle of its texel [0, 0].
    """
    picture = np.stack([body, np.ones_like(body)], axis=-1)
    picture = np.pad(picture, ((_BORDER, _BORDER), (_BORDER, _BORDER), (0, 0)))
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), _SOFT_TEXELS), np.float32)
    return Surface(picture, corner - _BORDER * TEXEL_M * (u + v), u, v, TEXEL_M, frame, solid)
