"""A lens as a vector of parameters, and what its uncertainty does to whatever is fitted with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ceilvo.camera import CameraModel

Array = NDArray[np.float64]

_MODEL_OF = {("fisheye", 4): "fisheye", ("pinhole", 8): "pinhole8", ("pinhole", 5): "pinhole"}
"""By the camera's kind and number of coefficients."""


_GUESSED_FOCAL = 0.8
"""Focal length over the picture's width of a lens nobody has measured: 64 deg across, a usual webcam's."""
BEHIND_PX = 1e3
"""Residual of a point behind the camera, which has no pixel: far, but finite, so that a fit can leave the place."""


def camera_of(model: str, p: Array, size: tuple[int, int]) -> CameraModel:
    """The camera of a parameter vector fx, fy, cx, cy, distortion."""
    kind: Literal["pinhole", "fisheye"] = "fisheye" if model == "fisheye" else "pinhole"
    fx, fy, cx, cy = (float(v) for v in p[:4])
    return CameraModel(kind, size[0], size[1], fx, fy, cx, cy, tuple(float(k) for k in p[4:]))


def parameters_of(camera: CameraModel) -> Array:
    return np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *camera.distortion])


def guessed_camera(size: tuple[int, int]) -> CameraModel:
    """Good enough to say how a board leans and how far it is."""
    w, h = size
    return camera_of("pinhole", np.array([_GUESSED_FOCAL * w, _GUESSED_FOCAL * w, w / 2, h / 2, *np.zeros(5)]), size)


def reprojection(camera: CameraModel, points: Array, uv_px: Array) -> Array:
    """(2 N,) pixels by which points (N, 3) in the camera's axes miss what was seen of them."""
    off = np.asarray((camera.pixels(points) - uv_px).ravel())
    off[np.isnan(off)] = BEHIND_PX
    return off


def lens_of(camera: CameraModel) -> tuple[Callable[[Array], CameraModel], Array] | None:
    """The camera as a function of its parameters, and those; None when its model is none of calib's."""
    model = _MODEL_OF.get((camera.kind, len(camera.distortion)))
    if model is None:
        return None
    size = (camera.width_px, camera.height_px)
    return (lambda p: camera_of(model, p, size)), parameters_of(camera)


def with_lens_error(cov: Array, response: Array, lens_cov: Array) -> Array:
    """cov plus what the lens' own uncertainty (K, K) does to the parameters, which move by response (P, K)."""
    return np.asarray(cov + response @ lens_cov @ response.T)
