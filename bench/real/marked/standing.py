"""A robot that stands under a photograph: the daemon's own pipeline on the same picture with a little noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.types import Frame, State

FRAMES = 60
SEED = 5
_PERIOD_NS = 66_666_667
"""15 Hz; chosen: 4 s in all."""
_GOOD = (State.TRACKING, State.DEGRADED)


@dataclass(frozen=True, slots=True)
class Stood:
    """What the daemon said.

    Attributes:
        frames: how many of each state, by its name.
        spread_m: farthest from the first pose.
        good_spread_m: the same of poses in TRACKING or DEGRADED; 0 where there are none.
        crossings: fewest and most in a frame.
    """

    frames: dict[str, int]
    spread_m: float
    good_spread_m: float
    crossings: tuple[int, int]

    @property
    def good(self) -> int:
        """Frames in TRACKING or DEGRADED."""
        return sum(self.frames.get(s.name, 0) for s in _GOOD)


def stand(gray: NDArray[np.uint8], calibration: Calibration, frames: int = FRAMES, seed: int = SEED) -> Stood:
    """Under one picture (H, W), each frame with its own noise of -1, 0 or 1 grey level a pixel; default settings."""
    base = Config()
    config = replace(base, base=replace(base.base, enabled=False), zenoh=replace(base.zenoh, enabled=False))
    pipeline = Pipeline(calibration, config, np.random.default_rng(seed))
    rng = np.random.default_rng(seed)
    said = []
    for k in range(frames):
        noisy = np.clip(gray + rng.integers(-1, 2, gray.shape, dtype=np.int16), 0, 255)
        said.append(pipeline.step(Frame(k, (k + 1) * _PERIOD_NS, noisy.astype(np.uint8))))
    off_m = np.array([np.hypot(*(e.pose - said[0].pose)[:2]) for e in said])
    good = np.array([e.state in _GOOD for e in said])
    names = [e.state.name for e in said]
    crossings = [e.crossings for e in said]
    return Stood(
        frames={name: names.count(name) for name in dict.fromkeys(names)},
        spread_m=float(off_m.max()),
        good_spread_m=float(off_m[good].max(initial=0.0)),
        crossings=(min(crossings), max(crossings)),
    )
