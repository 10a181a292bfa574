"""Radio anchors, marks and lamps of known place in the bench's hall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceilvo import se2
from ceilvo.bench.fusion.robot import Moment
from ceilvo.bench.fusion.said import Said
from ceilvo.bench.place.ceiling.worlds import World
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.relocalisation.beacons.mark_poses import corners
from ceilvo.senses.beacons import Anchor, Beacons, Lamp, LampSeen, Mark, MarkSeen, Range
from ceilvo.sim.radio import Radio, RadioSpec, in_corners, surveyed
from ceilvo.sim.rig import simulated_calibration
from ceilvo.types import Array

TAG_M = np.array([0.2, 0.1, 0.5])
"""Of the radio module in base."""
_ANCHORS, _SURVEY_M = 4, 0.05
_ROUND_TICKS = 10
"""10 Hz."""
_EVERY_M, _SIZE_M = 4.0, 0.2
"""Marks (so large) and lamps hang on a square grid; chosen: one is in view for half of the time."""
_PLACE_M, _TURN_RAD = 0.01, 0.01
"""Standard deviations of where they hang against the file."""
_CORNER_PX, _MARGIN_PX = 0.3, 10.0
_TILT_RAD, _TILT_M = float(np.radians(0.2)), 1.5
"""The floor tilts the robot by so much, changing over so much of the way; chosen: an ordinary floor."""
_EVERY_FRAMES = 3
"""beacons.marks_every."""


class RangesDevice:
    """A module on the robot and anchors in the hall's corners."""

    def __init__(self, world: World, rng: np.random.Generator) -> None:
        low, high = np.array(world.room[:2]), np.array(world.room[2:])
        anchors = tuple(_moved(a, world.map_from_ceiling) for a in in_corners(low, high, _ANCHORS, rng))
        self._radio = Radio(anchors, RadioSpec(), rng)
        self.beacons = Beacons(anchors=surveyed(anchors, _SURVEY_M, rng))
        self._waiting: tuple[Range, ...] = ()
        self._ticks = 0

    def live(self, moment: Moment) -> None:
        self._ticks += 1
        if self._ticks % _ROUND_TICKS == 0:
            at = moment.pose[:2] + se2.rotation(float(moment.pose[2])) @ TAG_M[:2]
            self._waiting += self._radio.ranges(moment.ns, np.array([*at, TAG_M[2]]))

    def tell(self, before_ns: int, stamp_ns: int, said: Said) -> None:
        said.heard, self._waiting = replace(said.heard, ranges=self._waiting), ()


class RangesSense:
    """Of the table of senses."""

    def configured(self, config: Config, world: World) -> Config:
        x, y, z = TAG_M.tolist()
        return replace(config, beacons=replace(config.beacons, tag_x_m=x, tag_y_m=y, tag_z_m=z))

    def device(self, world: World, config: Config, rng: np.random.Generator) -> RangesDevice:
        return RangesDevice(world, rng)


class _OnCeiling:
    """Things that hang on a square grid, and a robot that the floor tilts."""

    def __init__(self, world: World, calibration: Calibration, rng: np.random.Generator) -> None:
        self._rng, self._calibration = rng, calibration
        x, y = (np.arange(rng.uniform(1.0, _EVERY_M), world.room[k], _EVERY_M) for k in (2, 3))
        at = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        at = at + rng.uniform(-0.3, 0.3, at.shape)
        self._true = np.column_stack([se2.transform(world.map_from_ceiling, at), rng.uniform(-np.pi, np.pi, len(at))])
        self._moment: Moment | None = None
        self._way_m, self._frames = float(rng.uniform(0.0, 100.0)), 0

    def live(self, moment: Moment) -> None:
        self._moment = moment
        self._way_m += float(np.hypot(*moment.moved[:2]))

    def _looked_at(self) -> tuple[Moment, list[int]] | None:
        """What is shown of a frame that is looked at, and which things hang near; None of others."""
        self._frames += 1
        m = self._moment
        if m is None or m.dark or self._frames % _EVERY_FRAMES:
            return None
        return m, np.flatnonzero(np.hypot(*(self._true[:, :2] - m.pose[:2]).T) < _EVERY_M).tolist()

    def _pixels(self, pose: Array, thing: Array, points: Array) -> Array | None:
        """(N, 2) raw pixels of points (N, 2) of a thing at (3,) in map, None where one is not in the picture."""
        c, camera = self._calibration, self._calibration.camera
        in_base = se2.transform(np.asarray(se2.compose(se2.inverse(pose), thing)), points)
        phase = self._way_m / _TILT_M
        in_base = in_base + c.ceiling_height_m * _TILT_RAD * np.array([np.sin(phase), np.cos(1.3 * phase)])
        s = np.column_stack([in_base, np.ones(len(points))]) @ c.level_from_ceiling.T
        raw = c.level_view.to_raw(s[:, :2] / s[:, 2:]) + _CORNER_PX * self._rng.standard_normal(points.shape)
        size = np.array([camera.width_px, camera.height_px])
        inside = np.all((raw > _MARGIN_PX) & (raw < size - _MARGIN_PX))
        return np.asarray(raw) if inside else None


class MarksDevice(_OnCeiling):
    """Tags on the ceiling, seen whole or not at all."""

    def __init__(self, world: World, calibration: Calibration, rng: np.random.Generator) -> None:
        super().__init__(world, calibration, rng)
        off = np.array([_PLACE_M, _PLACE_M, _TURN_RAD]) * rng.standard_normal(self._true.shape)
        file = (self._true + off).tolist()
        self.beacons = Beacons(
            marks=tuple(Mark(k, _SIZE_M, x, y, t, _PLACE_M, _TURN_RAD) for k, (x, y, t) in enumerate(file))
        )

    def tell(self, before_ns: int, stamp_ns: int, said: Said) -> None:
        looked = self._looked_at()
        if looked is not None:
            m, near = looked
            seen = [(k, self._pixels(m.pose, self._true[k], corners(_SIZE_M))) for k in near]
            said.heard = replace(said.heard, marks=tuple(MarkSeen(k, c) for k, c in seen if c is not None))


class LampsDevice(_OnCeiling):
    """Lamps that look alike, by the middle of their light."""

    def __init__(self, world: World, calibration: Calibration, rng: np.random.Generator) -> None:
        super().__init__(world, calibration, rng)
        file = (self._true[:, :2] + _PLACE_M * rng.standard_normal((len(self._true), 2))).tolist()
        self.beacons = Beacons(lamps=tuple(Lamp(f"L{k}", x, y, 0.0, _PLACE_M) for k, (x, y) in enumerate(file)))

    def tell(self, before_ns: int, stamp_ns: int, said: Said) -> None:
        looked = self._looked_at()
        if looked is not None:
            m, near = looked
            seen = [self._pixels(m.pose, self._true[k], np.zeros((1, 2))) for k in near]
            said.heard = replace(said.heard, lamps=tuple(LampSeen(px[0]) for px in seen if px is not None))


class MarksSense:
    """Of the table of senses."""

    def configured(self, config: Config, world: World) -> Config:
        return config

    def device(self, world: World, config: Config, rng: np.random.Generator) -> MarksDevice:
        return MarksDevice(world, simulated_calibration(tile_m=world.spec.tile_m), rng)


class LampsSense:
    """Of the table of senses."""

    def configured(self, config: Config, world: World) -> Config:
        return config

    def device(self, world: World, config: Config, rng: np.random.Generator) -> LampsDevice:
        return LampsDevice(world, simulated_calibration(tile_m=world.spec.tile_m), rng)


def _moved(anchor: Anchor, map_from_room: Array) -> Anchor:
    x, y = se2.transform(map_from_room, np.array([[anchor.x_m, anchor.y_m]]))[0].tolist()
    return replace(anchor, x_m=x, y_m=y)
