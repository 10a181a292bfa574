"""What all tests share: one thread for OpenCV and hypothesis with fixed examples, so that a failure repeats."""

from __future__ import annotations

import os
from functools import lru_cache

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the daemon has it: the last bits depend on it
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(7680 * 4320))  # as ceilvo/__init__.py has it

import cv2
from hypothesis import settings

from ceilvo.sim import world
from ceilvo.sim.ceiling.ceiling import Ceiling
from ceilvo.sim.renderer import Renderer

settings.register_profile("fixed", derandomize=True, deadline=None, print_blob=True, max_examples=60)
settings.register_profile("explore", deadline=None, print_blob=True, max_examples=1000)
PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "fixed")
settings.load_profile(PROFILE)
cv2.setNumThreads(1)

# A ceiling takes a second to draw and light and never changes: the worlds of all tests share what is equal.
world.Ceiling = lru_cache(maxsize=4)(Ceiling)  # type: ignore[misc,assignment]
_light = Renderer._light
_lit: dict[tuple[object, ...], object] = {}


def _light_once(self: Renderer) -> object:
    key = (id(self._ceiling), self.spec, self._cal.camera.focal_px, self._cal.ceiling_height_m)
    if key not in _lit:
        _lit[key] = self._ceiling, _light(self)  # the ceiling with it, lest another gets its id
        while len(_lit) > 4:
            del _lit[next(iter(_lit))]
    return _lit[key][1]


Renderer._light = _light_once  # type: ignore[assignment,method-assign]


def pytest_report_header() -> str:
    return f"hypothesis: profile {PROFILE} (HYPOTHESIS_PROFILE=explore draws new examples); OpenCV {cv2.__version__}"
