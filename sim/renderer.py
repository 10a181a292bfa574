"""What the camera sees from a pose: geometry exact to a fraction of a pixel, light and noise as a sensor has them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ceilvo.calibration import Calibration
from ceilvo.errors import ConfigError
from ceilvo.sim.ceiling import Ceiling

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Gray = NDArray[np.uint8]

_STEEPEST = 12.0  # tan of the largest angle off the vertical that is drawn, beyond any ceiling
_NO_MAP: Any = None  # the map has two channels; the type stubs do not know that None is allowed
_BANK = 257  # the noise bank is larger than a frame by this many pixels


@dataclass(frozen=True)
class RenderSpec:
    """Light and sensor.

    Attributes:
        gain: grey levels of a white surface in full light.
        daylight: share of the room's light that does not come from lamps.
        lit: which of the ceiling's lamps are on, None for all, () for none.
        flicker_hz, flicker_depth: of the lamps' light (mains frequency doubled; depth 0..1).
        vignetting: loss of light in the corner farthest from the principal point.
        psf_px: standard deviation of the lens' blur.
        read_noise: grey levels.
        shot_noise: variance per grey level, grey levels.
        exposure_s: frames show the motion during it; 0 is a snapshot.
        sub_poses: snapshots that one exposure is made of.
        beyond: radiance where no ceiling is seen.
    """

    gain: float = 180.0
    daylight: float = 0.3
    lit: tuple[int, ...] | None = None
    flicker_hz: float = 100.0
    flicker_depth: float = 0.0
    vignetting: float = 0.35
    psf_px: float = 0.6
    read_noise: float = 1.2
    shot_noise: float = 0.02
    exposure_s: float = 0.0
    sub_poses: int = 5
    beyond: float = 0.25

    def __post_init__(self) -> None:
        for name in ("gain", "daylight", "flicker_hz", "psf_px", "read_noise", "shot_noise", "exposure_s", "beyond"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"render: {name} is {getattr(self, name)}, expected 0 or more")
        for name in ("flicker_depth", "vignetting"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"render: {name} is {getattr(self, name)}, expected 0 to 1")
        if self.sub_poses < 1:
            raise ConfigError(f"render: sub_poses is {self.sub_poses}, expected 1 or more")


class Renderer:
    """Draws frames. One thread at a time: it keeps scratch buffers."""

    def __init__(
        self, calibration: Calibration, ceiling: Ceiling, spec: RenderSpec | None = None, seed: int = 1
    ) -> None:
        self.spec = spec or RenderSpec()
        self._cal, self._ceiling = calibration, ceiling
        self._rays = _level_rays(calibration)
        self._textures = self._light()
        h, w = self._rays.shape[:2]
        rng = np.random.default_rng([seed, 0x0153])
        self._bank = rng.standard_normal((h + _BANK, w + _BANK), dtype=np.float32)
        self._vignette = _vignette(calibration, self.spec.vignetting)
        self._at = np.empty((h, w, 2), np.float32)
        self._sum = np.empty((h, w), np.float32)
        self._part = np.empty((h, w), np.float32)

    def render(
        self, pose: ArrayLike, rng: np.random.Generator, tilt_rad: ArrayLike = (0.0, 0.0), t_s: float = 0.0
    ) -> Gray:
        """One frame, (H, W) uint8, a new array.

        Args:
            pose: map_from_base, (3,), or (K, 3) for K snapshots evenly spread over the exposure.
            rng: picks the frame's noise.
            tilt_rad: (2,) or (K, 2), rotation vector about base x and y that turns the camera about its own centre.
            t_s: start of the exposure, for the flicker.
        """
        poses = np.atleast_2d(np.asarray(pose, np.float64))
        tilts = np.broadcast_to(np.asarray(tilt_rad, np.float64), (len(poses), 2))
        total = self._sum
        for i in range(len(poses)):
            out = self._part if i else total
            self._irradiance(poses[i], tilts[i], self._flicker(t_s), out)
            if i:
                cv2.add(total, out, dst=total)
        cv2.multiply(total, self._vignette, dst=total, scale=self.spec.gain / len(poses))
        return self._sense(total, rng)

    def _irradiance(self, pose: Array, tilt: Array, lamps: float, out: Array32) -> None:
        m = self._texel_from_ray(pose, tilt)
        if np.array_equal(m[2], [0.0, 0.0, 1.0]):
            cv2.transform(self._rays, m[:2], dst=self._at)
        else:
            cv2.perspectiveTransform(self._rays, m, dst=self._at)
        base, extra = self._textures
        self._sample(base, out)
        if extra is not None:
            other = np.empty_like(out)
            self._sample(extra, other)
            cv2.scaleAdd(other, lamps, out, dst=out)

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
        h = self._cal.ceiling_height_m
        mx, my = self._cal.mount_xy_m
        ceiling_from_ray = np.array([[h, 0.0, mx], [0.0, h, my], [0.0, 0.0, 1.0]])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        map_from_base = np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])
        m = self._ceiling.texel_from_map @ map_from_base @ ceiling_from_ray
        if tilt.any():
            m = m @ cv2.Rodrigues(np.array([tilt[0], tilt[1], 0.0]))[0]
        return np.asarray(m)

    def _light(self) -> tuple[Array32, Array32 | None]:
        """The picture as the lens blurs it; the lamps' part kept apart only when it flickers."""
        day, lamps = self._ceiling.radiance(self.spec.lit, self.spec.daylight)
        texel_px = self._ceiling.spec.texel_m * self._cal.level_view.focal_px / self._cal.ceiling_height_m
        sigma = self.spec.psf_px / texel_px
        parts = [day, lamps] if self.spec.flicker_depth > 0 else [day + lamps]
        if sigma > 0:
            parts = [np.asarray(cv2.GaussianBlur(p, (0, 0), sigma), np.float32) for p in parts]
        return parts[0], parts[1] if len(parts) > 1 else None

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


def _level_rays(calibration: Calibration) -> Array32:
    """(H, W, 2) x / z and y / z of each pixel's ray in base."""
    cam = calibration.camera
    grid = np.stack(np.meshgrid(np.arange(cam.width_px), np.arange(cam.height_px)), axis=-1)
    r = cam.rays(grid.reshape(-1, 2).astype(np.float64)) @ calibration.camera_from_base  # base_from_camera, transposed
    xy = r[:, :2] / np.maximum(r[:, 2:], 1e-6)
    steep = np.maximum(np.hypot(xy[:, 0], xy[:, 1]) / _STEEPEST, 1.0)
    return np.asarray((xy / steep[:, None]).reshape(cam.height_px, cam.width_px, 2), np.float32)


def _vignette(calibration: Calibration, loss: float) -> Array32:
    """(H, W) factor, 1 at the principal point and 1 - loss in the farthest corner."""
    cam = calibration.camera
    x = np.arange(cam.width_px)[None, :] - cam.cx_px
    y = np.arange(cam.height_px)[:, None] - cam.cy_px
    r2 = x * x + y * y
    return np.asarray(1.0 - loss * r2 / r2.max(), np.float32)
