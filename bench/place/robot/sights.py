"""What the robot's camera gives to the daemon: crossings made by the synthetic eye, or pictures that are rendered."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.bench.place.ceiling.eye import PLAIN, Sight, SyntheticEye
from ceilvo.bench.place.ceiling.truth import Features
from ceilvo.calibration import Calibration, mount_angles
from ceilvo.crossing_types import crossing_type_of, quarter_turns, turned_type
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.replay.inputs import FrameInput, Sighting, Silence, apply
from ceilvo.se2 import rotation
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.sim.renderer import Renderer
from ceilvo.types import Array, Crossings, Estimate, Frame, WheelMotion

Seen = Any
"""Of one moment: Crossings or None from CrossingSight, an (H, W) uint8 picture from PictureSight."""
_JITTER_M = 3e-5
"""By which crossings of one picture with a bit of noise differ: 10 to 60 um on rendered frames of a room, where new
noise on all bits makes 30 to 100 um."""


def estimated(pipeline: Pipeline, given: FrameInput | Sighting | Silence) -> Estimate:
    """What comes of an input, given as the daemon gives it."""
    estimate = apply(pipeline, given)
    assert estimate is not None  # of these inputs there always is one
    return estimate


class Camera(Protocol):
    """Looks, spoils what it saw, and hands it to the daemon."""

    def look(self, pose: Array, sight: Sight) -> Seen: ...

    def dark(self) -> Seen: ...

    def mirrored(self, seen: Seen) -> Seen: ...

    def turned(self, seen: Seen) -> Seen: ...

    def again(self, seen: Seen) -> Seen:
        """The same picture with a bit of noise."""

    def give(
        self, pipeline: Pipeline, stamp_ns: int, seen: Seen, wheels: WheelMotion | None, heard: Heard = NOTHING
    ) -> Estimate: ...


class CrossingSight:
    """Without pictures, fast."""

    def __init__(self, eye: SyntheticEye, calibration: Calibration, rng: np.random.Generator) -> None:
        self.eye = eye
        self._calibration, self._rng = calibration, rng
        self._yaw_rad = mount_angles(calibration.camera_from_base)[0]

    def use(self, features: Features) -> None:
        """Another ceiling."""
        self.eye = SyntheticEye(features, self._calibration, self._rng)

    def look(self, pose: Array, sight: Sight = PLAIN) -> Crossings | None:
        return self.eye.look(pose, sight)

    def dark(self) -> None:
        return None

    def mirrored(self, seen: Crossings | None) -> Crossings | None:
        """Left and right exchanged in the picture: the normal of axis 0 is turned round with it."""
        if seen is None:
            return None
        k0, k1 = seen.crossing_type // 3 - 1, seen.crossing_type % 3 - 1
        psi = 2.0 * self._yaw_rad - seen.psi_rad  # in [-pi/4, pi/4) again, but for the mounting's few degrees
        psi_wrapped = float((psi + 0.25 * np.pi) % (0.5 * np.pi) - 0.25 * np.pi)
        kind = turned_type(crossing_type_of(-k0, k1), quarter_turns(psi, psi_wrapped))
        out = replace(seen, psi_rad=psi_wrapped, crossing_type=kind)
        return self._moved(out, self._flipped(seen.xy_base_m, np.array([-1.0, 1.0])))

    def turned(self, seen: Crossings | None) -> Crossings | None:
        if seen is None:
            return None
        out = replace(seen, crossing_type=turned_type(seen.crossing_type, 2))
        return self._moved(out, self._flipped(seen.xy_base_m, np.array([-1.0, -1.0])))

    def _flipped(self, xy_base_m: Array, sign: Array) -> Array:
        """(M, 2) where pixels are exchanged across the picture's middle along its axes of sign -1; lens not counted."""
        camera, mount = self._calibration.camera, self._calibration.mount_xy_m
        size = np.array([camera.width_px, camera.height_px])
        centre = np.array([camera.cx_px, camera.cy_px])
        off_m = (size - 1.0 - 2.0 * centre) * self._calibration.ceiling_height_m / camera.focal_px
        turn = rotation(self._yaw_rad)
        inside = (xy_base_m - mount) @ turn
        return np.asarray((inside * sign + off_m * (sign < 0)) @ turn.T + mount)

    def again(self, seen: Crossings | None) -> Crossings | None:
        if seen is None:
            return None
        return self._moved(seen, seen.xy_base_m + _JITTER_M * self._rng.standard_normal(seen.xy_base_m.shape))

    def give(
        self,
        pipeline: Pipeline,
        stamp_ns: int,
        seen: Crossings | None,
        wheels: WheelMotion | None,
        heard: Heard = NOTHING,
    ) -> Estimate:
        return estimated(pipeline, Sighting(stamp_ns, seen, wheels, heard))

    def _moved(self, seen: Crossings, xy_base_m: Array) -> Crossings:
        s = np.column_stack([xy_base_m, np.ones(len(xy_base_m))]) @ self._calibration.level_from_ceiling.T
        return replace(seen, xy_base_m=xy_base_m, uv_px=s[:, :2] / s[:, 2:])


class PictureSight:
    """Rendered frames, through the crossing finder."""

    def __init__(self, renderer: Renderer, calibration: Calibration, rng: np.random.Generator) -> None:
        self._renderer, self._rng = renderer, rng
        self._size = (calibration.camera.height_px, calibration.camera.width_px)
        self._seq = 0

    def look(self, pose: Array, sight: Sight = PLAIN) -> NDArray[np.uint8]:
        """sight: yaw_rad alone is shown."""
        return self._renderer.render(se2.compose(pose, np.array([0.0, 0.0, sight.yaw_rad])), self._rng)

    def dark(self) -> NDArray[np.uint8]:
        return np.asarray(self._rng.integers(0, 3, self._size), np.uint8)

    def mirrored(self, seen: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.ascontiguousarray(seen[:, ::-1])

    def turned(self, seen: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.ascontiguousarray(seen[::-1, ::-1])

    def again(self, seen: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return np.asarray(seen ^ self._rng.integers(0, 2, self._size), np.uint8)

    def give(
        self,
        pipeline: Pipeline,
        stamp_ns: int,
        seen: NDArray[np.uint8],
        wheels: WheelMotion | None,
        heard: Heard = NOTHING,
    ) -> Estimate:
        self._seq += 1
        return estimated(pipeline, FrameInput(Frame(self._seq, stamp_ns, seen), wheels, heard))
