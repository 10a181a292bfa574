"""What somebody who looks on gets to see while the board is held into the picture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.evaluate.coverage import Coverage, Light, coverage
from ceilvo.calib.session.watch import Look, Watch
from ceilvo.calib.solve.intrinsics import MIN_SHOTS, Shot, calibrate
from ceilvo.calib.targets.sources import Picture
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

_EVERY = 3
"""Accepted views from one provisional lens to the next; chosen: it takes a third of a second."""


class LensWatch:
    """Tells a Watch of every picture of the board; a provisional pinhole gives the residual of each accepted one."""

    def __init__(self, watch: Watch, part: str) -> None:
        self._watch, self._part = watch, part
        self._rms_px: dict[int, float] = {}
        self._fitted = 0

    @property
    def ended(self) -> bool:
        return self._watch.ended

    def dropped(self) -> list[int]:
        return self._watch.dropped(self._part)

    def __call__(
        self,
        picture: Picture,
        reason: str,
        uv_px: Array | None,
        shots: list[Shot],
        light: Light | None,
        covered: Coverage | None = None,
    ) -> None:
        if not self._watch.present:
            return
        h, w = picture.gray.shape
        if covered is None:
            covered = coverage(shots, (w, h), light)
        if len(shots) >= MIN_SHOTS and abs(len(shots) - self._fitted) >= _EVERY:
            self._fit(shots, (w, h))
        missing = covered.missing()
        if len(shots) < MIN_SHOTS:
            missing.append(f"{len(shots)} pictures, at least {MIN_SHOTS} needed, better 20")
        views = [(s.name, self._rms_px.get(id(s))) for s in shots]
        seen = np.zeros((0, 2)) if uv_px is None else uv_px
        facts = _facts(covered, shots) | {"missing": missing}
        self._watch.looked(
            Look(self._part, picture, reason, not reason, seen, views, facts, missing[0] if missing else "")
        )

    def _fit(self, shots: list[Shot], size: tuple[int, int]) -> None:
        self._fitted = len(shots)
        try:
            found = calibrate(shots, size, "pinhole", keep_all=True)
        except CalibrationError:
            return
        self._rms_px = {id(s): float(r) for s, r in zip(found.shots, found.shot_rms_px, strict=True)}


def _facts(covered: Coverage, shots: list[Shot]) -> dict[str, Any]:
    return {
        "cells": covered.cells,
        "lit": covered.lit,
        "empty": covered.empty_parts(),
        "text": covered.text,
        "area": covered.area,
        "tilted": covered.tilted,
        "distance_ratio": covered.distance_ratio,
        "corners_px": [s.uv_px.round(1) for s in shots],
    }
