"""A ceiling takes a second to draw and light and never changes: the worlds of a process share what is equal."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import lru_cache

from ceilvo.calibration import Calibration
from ceilvo.sim import renderer, world
from ceilvo.sim.ceiling.ceiling import Ceiling
from ceilvo.sim.ceiling.spec import CeilingSpec
from ceilvo.sim.rays import level_rays
from ceilvo.sim.renderer import Renderer

MOST = 4
"""Ceilings that are kept; chosen: some tens of megabytes each."""
_light = Renderer._light
_lit: dict[tuple[object, ...], object] = {}
_rays: dict[tuple[object, ...], object] = {}


def _light_once(self: Renderer) -> object:
    key = (id(self._ceiling), self.spec, self._cal.camera.focal_px, self._cal.ceiling_height_m)
    if key not in _lit:
        _lit[key] = self._ceiling, _light(self)  # the ceiling with it, lest another gets its id
        _forget(_lit)
    return _lit[key][1]


def _rays_once(calibration: Calibration) -> object:
    key = (calibration.camera, calibration.camera_from_base.tobytes())
    if key not in _rays:
        _rays[key] = level_rays(calibration)
        _forget(_rays)
    return _rays[key]


def _forget(known: dict[tuple[object, ...], object]) -> None:
    while len(known) > MOST:
        del known[next(iter(known))]


_level = lru_cache(maxsize=MOST)(Ceiling)


@lru_cache(maxsize=MOST)
def _ceiling_once(spec: CeilingSpec, seed: int) -> Ceiling:
    """One that slopes is drawn as if it did not: only its renderer asks."""
    found = _level(replace(spec, slope=(0.0, 0.0)), seed)
    if spec != found.spec:
        found = copy(found)
        found.spec = spec
    return found


def share() -> None:
    """From now on."""
    world.Ceiling = _ceiling_once  # type: ignore[misc,assignment]
    renderer.level_rays = _rays_once  # type: ignore[assignment]
    Renderer._light = _light_once  # type: ignore[assignment,method-assign]
