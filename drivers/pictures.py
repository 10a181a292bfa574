"""Image files; ceilvo/__init__.py limits their size, of which a few hundred bytes may say a gigabyte."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Gray = NDArray[np.uint8]

_JPEG_QUALITY = 80
"""Of 100, of pictures that are to look at; chosen."""
_AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION  # the calibration knows the sensor's rows and columns


def decoded(data: bytes | Gray) -> Gray | None:
    """(H, W) grey levels of an image file in any type that OpenCV reads; None where it is none, or too large a one."""
    raw = np.frombuffer(data, np.uint8) if isinstance(data, bytes) else data
    if not raw.size:
        return None
    try:
        image = cv2.imdecode(raw, _AS_STORED)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image, np.uint8)


def jpeg(image: Gray) -> bytes:
    """A picture to look at: (H, W) grey or (H, W, 3) BGR."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    return np.asarray(data, np.uint8).tobytes()
