"""A lens as a vector of parameters, and what its uncertainty does to whatever is fitted with it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ceilvo.camera import CameraModel

Array = NDArray[np.float64]

_MODEL_OF = {("fisheye", 4): "fisheye", ("pinhole", 8): "pinhole8", ("pinhole", 5): "pinhole"}


def camera_of(model: str, p: Array, size: tuple[int, int]) -> CameraModel:
    """The camera of a parameter vector fx, fy, cx, cy, distortion."""
    kind: Literal["pinhole", "fisheye"] = "fisheye" if model == "fisheye" else "pinhole"
    fx, fy, cx, cy = (float(v) for v in p[:4])
    return CameraModel(kind, size[0], size[1], fx, fy, cx, cy, tuple(float(k) for k in p[4:]))


def parameters_of(camera: CameraModel) -> Array:
    return np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, *camera.distortion])


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
