"""What the camera sees from a pose: geometry exact to a fraction of a pixel, light and noise as a sensor has them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.errors import ConfigError
from ceilvo.sim.ceiling.ceiling import Ceiling
from ceilvo.sim.gloss import Gloss, add_gloss
from ceilvo.sim.rays import along_rows, footprints, level_rays, map_rays, middle, turned, vignette
from ceilvo.sim.surroundings.surface import Surface

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Gray = NDArray[np.uint8]

_NO_MAP: Any = None  # the map has two channels; the type stubs do not know that None is allowed
_PARALLEL, _TOUCHING, _HALF = np.float32(1e-6), np.float32(1e-3), 0.5
"""A ray so nearly in a plane never meets it; surfaces that touch, in metres; from this alpha on a surface hides."""
_LEVEL_STEP, _MOST_LEVELS = 1.5, 5
"""From one blurred copy of the ceiling to the next, and at most so many; chosen: between two the blur is right to 2 %,
and the widest is that of 67 deg off the vertical."""
_BANK = 257  # the noise bank is larger than a frame by this many pixels


@dataclass(frozen=True)
class RenderSpec:
    """Light and sensor.

    Attributes:
        gain: grey levels of a white surface in full light.
        daylight: fraction of the room's light that does not come from lamps.
        lit: which of the ceiling's lamps are on, None for all, () for none.
        flicker_hz, flicker_depth: of the lamps' light (mains frequency doubled; depth 0..1).
        switch_groups, switch_period_s: lamps are wired in so many groups; in each period one group in turn is off, and
            in every last one none. 0 groups never switch.
        vignetting: loss of light in the corner farthest from the principal point.
        psf_px: standard deviation of the lens' blur.
        read_noise: grey levels.
        shot_noise: variance per grey level, grey levels.
        exposure_s: frames show the motion during it; 0 is a snapshot.
        sub_poses: snapshots that one exposure is made of.
        beyond: radiance where no ceiling is seen.
        footprint: the lens blurs what is seen askance over as many pixels as what is straight above, so over more of
            the ceiling: nothing finer than a pixel is left to sparkle. False blurs the ceiling alike everywhere.
        gloss: lights below the ceiling that it reflects; their images move with the robot.
    """

    gain: float = 180.0
    daylight: float = 0.3
    lit: tuple[int, ...] | None = None
    flicker_hz: float = 100.0
    flicker_depth: float = 0.0
    switch_groups: int = 0
    switch_period_s: float = 2.0
    vignetting: float = 0.35
    psf_px: float = 0.6
    read_noise: float = 1.2
    shot_noise: float = 0.02
    exposure_s: float = 0.0
    sub_poses: int = 5
    beyond: float = 0.25
    footprint: bool = False
    gloss: tuple[Gloss, ...] = ()

    def __post_init__(self) -> None:
        for name in ("gain", "daylight", "flicker_hz", "psf_px", "read_noise", "shot_noise", "exposure_s", "beyond"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"render: {name} is {getattr(self, name)}, expected 0 or more")
        for name in ("flicker_depth", "vignetting"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"render: {name} is {getattr(self, name)}, expected 0 to 1")
        if self.switch_groups < 0 or not self.switch_period_s > 0:
            raise ConfigError(
                f"render: switch_groups is {self.switch_groups} and switch_period_s {self.switch_period_s}, expected 0 "
                "or more groups and a period above 0"
            )
        if self.sub_poses < 1:
            raise ConfigError(f"render: sub_poses is {self.sub_poses}, expected 1 or more")


class Renderer:
    """Draws frames. One thread at a time: it keeps scratch buffers."""

    def __init__(
        self,
        calibration: Calibration,
        ceiling: Ceiling,
        spec: RenderSpec | None = None,
        seed: int = 1,
        surfaces: tuple[Surface, ...] = (),
    ) -> None:
        self.spec = spec or RenderSpec()
        self._cal, self._ceiling, self._surfaces = calibration, ceiling, surfaces
        self._rays = level_rays(calibration)
        self._coarse_rays = np.ascontiguousarray(self._rays[::12, ::12])
        self._scales, self._weights = self._levels()
        self._groups = self._wiring()
        self._textures = self._light()
        h, w = self._rays.shape[:2]
        rng = np.random.default_rng([seed, 0x0153])
        self._bank = rng.standard_normal((h + _BANK, w + _BANK), dtype=np.float32)
        self._vignette = vignette(calibration, self.spec.vignetting)
        self._at = np.empty((h, w, 2), np.float32)
        self._sum = np.empty((h, w), np.float32)
        self._part = np.empty((h, w), np.float32)

    def render(
        self, pose: ArrayLike, rng: np.random.Generator, tilt_rad: ArrayLike = (0.0, 0.0), t_s: float = 0.0
    ) -> Gray:
        """One frame, (H, W) uint8, a new array.

        Args:
            pose: map_from_base, (3,), or (K, 3) for K snapshots spread uniformly over the exposure. (K, N, 3) of a
                rolling shutter: N poses from the time of the first row to that of the last, in even steps.
            rng: picks the frame's noise.
            tilt_rad: (2,), (K, 2) or (K, N, 2), rotation vector about base x and y that turns the camera about its own
                centre.
            t_s: start of the exposure, for the flicker.
        """
        poses = np.atleast_2d(np.asarray(pose, np.float64))
        tilts = np.broadcast_to(np.asarray(tilt_rad, np.float64), (*poses.shape[:-1], 2))
        total, lamps = self._sum, self.lamp_shares(t_s)
        for i in range(len(poses)):
            out = self._part if i else total
            self._irradiance(poses[i], tilts[i], lamps, out)
            if i:
                cv2.add(total, out, dst=total)
        cv2.multiply(total, self._vignette, dst=total, scale=self.spec.gain / len(poses))
        return self._sense(total, rng)

    def lamp_shares(self, t_s: float) -> Array:
        """(G,) light of each group of lamps in the exposure that starts at t_s, 1 = steady and on."""
        n = self.spec.switch_groups
        lit = np.full(max(n, 1), self._flicker(t_s))
        if n:
            slot = int(t_s // self.spec.switch_period_s)
            lit[(slot + np.arange(n)) % (n + 1) == 0] = 0.0
        return lit

    def occlusion(self, pose: ArrayLike, tilt_rad: ArrayLike = (0.0, 0.0)) -> Array32:
        """(H, W) how much of each pixel's ceiling is hidden by something else, 0..1."""
        clear = np.ones(self._rays.shape[:2], np.float32)
        for _, alpha in self._in_front(np.asarray(pose, np.float64), np.asarray(tilt_rad, np.float64)):
            clear *= 1.0 - alpha
        return np.asarray(1.0 - clear, np.float32)

    def _irradiance(self, pose: Array, tilt: Array, lamps: Array, out: Array32) -> None:
        map_rays(self._rays, along_rows(self._texel_from_ray, pose, tilt), self._at)
        base, parts = self._textures
        self._read(base, out)
        for part, lit in zip(parts, lamps, strict=False):
            if lit > 0:
                other = np.empty_like(out)
                self._read(part, other)
                cv2.scaleAdd(other, float(lit), out, dst=out)
        if self.spec.gloss:
            camera_m = se2.transform(middle(pose), self._cal.mount_xy_m[None])[0]
            texels = (self._ceiling.texel_from_map, self._ceiling.spec.texel_m)
            add_gloss(self.spec.gloss, camera_m, self._height_m(middle(pose)), texels, self._at, out)
        if self._surfaces:
            ambient = self._ambient(lamps)
            for light, alpha in self._in_front(pose, tilt):
                out *= 1.0 - alpha
                cv2.scaleAdd(light, ambient, out, dst=out)

    def _in_front(self, pose: Array, tilt: Array) -> Iterator[tuple[Array32, Array32]]:
        """Radiance times alpha, and alpha, of every surface in view, far ones first."""
        nearest = self._ceiling_distance(pose, tilt) if any(s.solid for s in self._surfaces) else None
        for s in self._surfaces:
            m = along_rows(partial(self._texel_of, s), pose, tilt)
            h, w = s.picture.shape[:2]
            ends = [cv2.perspectiveTransform(self._coarse_rays, end) for end in m.reshape(-1, 3, 3)[[0, -1]]]
            if not any(np.any((at > -1).all(axis=2) & (at[..., 0] < w) & (at[..., 1] < h)) for at in ends):
                continue
            if m.ndim == 2:
                cv2.perspectiveTransform(self._rays, m, dst=self._at)
            else:
                map_rays(self._rays, m, self._at)
            seen = cv2.remap(s.picture, self._at, _NO_MAP, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            light, alpha = (np.asarray(part, np.float32) for part in cv2.split(seen))
            if s.solid and nearest is not None:
                behind = self._behind(s, middle(pose), middle(tilt), alpha, nearest)
                light[behind], alpha[behind] = 0.0, 0.0
            yield light, alpha

    def _ceiling_distance(self, pose: Array, tilt: Array) -> Array32:
        """(H, W) how many rays away the ceiling is; where rows see other poses, from the middle one."""
        m = self._texel_from_ray(middle(pose), middle(tilt))
        return self._distance(self._height_m(middle(pose)), m)

    def _distance(self, along_normal_m: float, m: Array) -> Array32:
        along = self._rays @ m[2, :2].astype(np.float32) + np.float32(m[2, 2])
        away = np.float32(along_normal_m) / np.where(np.abs(along) < _PARALLEL, _PARALLEL, along)
        return np.asarray(np.where(away > 0, away, np.inf), np.float32)

    def _behind(self, s: Surface, pose: Array, tilt: Array, alpha: Array32, nearest: Array32) -> NDArray[np.bool_]:
        """(H, W) where something nearer was drawn; else this is the nearest now."""
        away = self._distance(s.distance(pose, self._cal.mount_xy_m), self._texel_of(s, pose, tilt))
        behind = away > nearest + _TOUCHING
        drawn = ~behind & (alpha > _HALF)
        nearest[drawn] = away[drawn]
        return np.asarray(behind)

    def _texel_of(self, surface: Surface, pose: Array, tilt: Array) -> Array:
        return turned(surface.texel_from_ray(pose, self._cal.mount_xy_m), tilt)

    def _ambient(self, lamps: Array) -> float:
        """Light on what is not the ceiling."""
        day = self.spec.daylight
        n = len(self._ceiling.layout.lamps)
        on = n if self.spec.lit is None else len(self.spec.lit)
        return float(day + (1.0 - day) * (on / n if n else 1.0) * np.mean(lamps))

    def _read(self, copies: list[Array32], out: Array32) -> None:
        """What the pixels see of the ceiling: of its blurred copies each one those that its footprint lies between."""
        if not self._weights:
            self._sample(copies[0], out)
            return
        out[:] = 0.0
        seen = np.empty_like(out)
        for copy, weight in zip(copies, self._weights, strict=True):
            self._sample(copy, seen)
            seen *= weight
            out += seen

    def _levels(self) -> tuple[list[float], list[Array32]]:
        """How much wider than straight above each copy of the ceiling is blurred, and (H, W) weights of the copies."""
        if not self.spec.footprint:
            return [1.0], []
        wide = np.log(np.maximum(footprints(self._rays, self._cal.camera.focal_px), 1.0)) / np.log(_LEVEL_STEP)
        steps = np.minimum(wide, _MOST_LEVELS - 1.0)
        count = int(np.ceil(float(steps.max()))) + 1
        weights = [np.asarray(np.maximum(1.0 - np.abs(steps - k), 0.0), np.float32) for k in range(count)]
        return [_LEVEL_STEP**k for k in range(count)], weights

    def _sample(self, texture: Array32, out: Array32) -> None:
        cv2.remap(
            texture,
            self._at,
            _NO_MAP,
            cv2.INTER_LINEAR,
            dst=out,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=self.spec.beyond,
        )

    def _texel_from_ray(self, pose: Array, tilt: Array) -> Array:
        """(3, 3) homography from rays in the untilted base frame, scaled to unit height, to the texture."""
        h = self._height_m(pose)
        mx, my = self._cal.mount_xy_m
        c, s = np.cos(pose[2]), np.sin(pose[2])
        gx, gy = self._ceiling.spec.slope
        ahead, left = c * gx + s * gy, c * gy - s * gx
        level = np.array([-ahead, -left, 1.0])  # rays away from the camera: h over this times the ray
        ceiling_from_ray = np.array([[h, 0.0, 0.0], [0.0, h, 0.0], level]) + np.outer([mx, my, 0.0], level)
        map_from_base = np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])
        m = self._ceiling.texel_from_map @ map_from_base @ ceiling_from_ray
        return turned(m, tilt)

    def _height_m(self, pose: Array) -> float:
        """Of the ceiling above the camera."""
        rise = np.array(self._ceiling.spec.slope)
        if not rise.any():
            return self._cal.ceiling_height_m
        camera = se2.transform(pose, self._cal.mount_xy_m[None])[0]
        return float(self._cal.ceiling_height_m + rise @ (camera - 0.5 * self._ceiling.spec.room_m))

    def _wiring(self) -> list[tuple[int, ...]]:
        """Lamps of each group that switches."""
        n = self.spec.switch_groups
        lit = range(len(self._ceiling.layout.lamps)) if self.spec.lit is None else self.spec.lit
        return [tuple(i for i in lit if i % n == g) for g in range(n)]

    def _light(self) -> tuple[list[Array32], list[list[Array32]]]:
        """The picture as the lens blurs it, its copies for each footprint; the lamps' part kept apart only when it
        flickers or switches."""
        day, lamps = self._ceiling.radiance(self.spec.lit, self.spec.daylight)
        texel_px = self._ceiling.spec.texel_m * self._cal.camera.focal_px / self._cal.ceiling_height_m
        sigma = self.spec.psf_px / texel_px
        if self._groups:
            parts = [day, *(self._ceiling.radiance(g, self.spec.daylight)[1] for g in self._groups)]
        else:
            parts = [day, lamps] if self.spec.flicker_depth > 0 else [day + lamps]
        copies = [[_blurred(p, sigma * scale) for scale in self._scales] for p in parts]
        return copies[0], copies[1:]

    def _flicker(self, t_s: float) -> float:
        """Mean of the lamps' light over the exposure."""
        w = 2 * np.pi * self.spec.flicker_hz
        e = self.spec.exposure_s
        half = 0.5 * w * e
        mean = np.sin(w * t_s + half) * (np.sin(half) / half if half > 0 else 1.0)
        return float(1.0 + self.spec.flicker_depth * mean)

    def _sense(self, signal: Array32, rng: np.random.Generator) -> Gray:
        """Shot and read noise, saturation, 8 bits."""
        if self.spec.read_noise == 0 and self.spec.shot_noise == 0:
            return np.asarray(cv2.convertScaleAbs(signal), np.uint8)
        i, j = rng.integers(0, _BANK, 2)
        h, w = signal.shape
        noise = self._part
        np.multiply(signal, np.float32(self.spec.shot_noise), out=noise)
        np.add(noise, np.float32(self.spec.read_noise**2), out=noise)
        cv2.sqrt(noise, dst=noise)
        cv2.multiply(noise, self._bank[i : i + h, j : j + w], dst=noise)
        return np.asarray(cv2.add(signal, noise, dtype=cv2.CV_8U), np.uint8)


def _blurred(picture: Array32, sigma: float) -> Array32:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), sigma), np.float32) if sigma > 0 else picture
