"""A ceiling takes a second to draw and light and never changes: the worlds of a process share what is equal."""

from __future__ import annotations

from functools import lru_cache

from ceilvo.sim import world
from ceilvo.sim.ceiling.ceiling import Ceiling
from ceilvo.sim.renderer import Renderer

MOST = 4
"""Ceilings that are kept; chosen: some tens of megabytes each."""
_light = Renderer._light
_lit: dict[tuple[object, ...], object] = {}


def _light_once(self: Renderer) -> object:
    key = (id(self._ceiling), self.spec, self._cal.camera.focal_px, self._cal.ceiling_height_m)
    if key not in _lit:
        _lit[key] = self._ceiling, _light(self)  # the ceiling with it, lest another gets its id
        while len(_lit) > MOST:
            del _lit[next(iter(_lit))]
    return _lit[key][1]


def share() -> None:
    """From now on."""
    world.Ceiling = lru_cache(maxsize=MOST)(Ceiling)  # type: ignore[misc,assignment]
    Renderer._light = _light_once  # type: ignore[assignment,method-assign]
