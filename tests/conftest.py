"""What all tests share: one thread for OpenCV and hypothesis with fixed examples, so that a failure repeats."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the daemon has it: the last bits depend on it
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(7680 * 4320))  # as ceilvo/__init__.py has it

import cv2
import drawn_once
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None, print_blob=True, max_examples=60)
settings.register_profile("explore", deadline=None, print_blob=True, max_examples=1000)
PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "fixed")
settings.load_profile(PROFILE)
cv2.setNumThreads(1)

drawn_once.share()


def pytest_report_header() -> str:
    return f"hypothesis: profile {PROFILE} (HYPOTHESIS_PROFILE=explore draws new examples); OpenCV {cv2.__version__}"
