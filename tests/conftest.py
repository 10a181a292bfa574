"""What all tests share: one thread for OpenCV and hypothesis with fixed examples, so that a failure repeats."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the daemon has it: the last bits depend on it
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(7680 * 4320))  # as ceilvo/__init__.py has it

import cv2
import drawn_once
import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, deadline=None, print_blob=True, max_examples=60)
settings.register_profile("explore", deadline=None, print_blob=True, max_examples=1000)
PROFILE = os.environ.get("HYPOTHESIS_PROFILE", "fixed")
settings.load_profile(PROFILE)
cv2.setNumThreads(1)

drawn_once.share()


def pytest_report_header() -> str:
    return f"hypothesis: profile {PROFILE} (HYPOTHESIS_PROFILE=explore draws new examples); OpenCV {cv2.__version__}"


@pytest.fixture(autouse=True)
def log_handlers() -> Iterator[None]:
    """The command line installs its own, which would outlive the test."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
