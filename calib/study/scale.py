"""Wrong tiles over many rigs: what each second source notices, and how often it refuses a right one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.evaluate import scale
from ceilvo.calib.practice.virtual_bench import VirtualBench
from ceilvo.calib.solve.grid import from_grid
from ceilvo.calib.targets.ceiling_view import CeilingReader
from ceilvo.calibration import Calibration
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

TRUE_TILE_M = 0.6
TILES_M = (0.6, 0.576, 0.625, 0.5, 0.7, 0.3, 0.9)
"""Said to be the side of tiles of 0.6 m: right, and wrong by 4, 17 and 50 % either way."""
SOURCES = ("height", "marks", "wheels")
_PLACES = 8
_APART_M = (0.6, 1.0)
"""Between two marks: what a person reaches on a ladder."""
_RUN_M, _RUN_SIGMA = 2.4, 0.001
"""Of the run; and of its scale from its own scatter, as calib mount finds it on the virtual bench."""


def figures(rig: Calibration, seed: int, draws: int = 20) -> dict[str, Any]:
    """For each tile and source how many of the draws were refused; errors of hand and wheels are drawn each time."""
    rng = np.random.default_rng([seed, 0x5CA1E])
    reader = CeilingReader(rig.camera)
    views = [v for v in (reader(p.gray) for p in VirtualBench(rig, seed=seed).places(_PLACES)) if v.ok]
    refused: dict[str, dict[str, int]] = {}
    for tile_m in TILES_M:
        counts = dict.fromkeys(SOURCES, 0)
        try:
            alone, _ = from_grid(rig.camera, views, tile_m, reader.tilt_rad)
        except CalibrationError:
            refused[f"{tile_m:g}"] = dict.fromkeys(SOURCES, draws)
            continue
        level = np.array([alone.roll_rad, alone.pitch_rad, alone.height_m])
        for _ in range(draws):
            for source, found in _sources(rig, level, float(alone.sigma[2]), rng):
                counts[source] += int(not found.confirms)
        refused[f"{tile_m:g}"] = counts
    return {"draws": draws, "by_tile": refused}


def _sources(
    rig: Calibration, level: Array, sigma_m: float, rng: np.random.Generator
) -> Iterator[tuple[str, scale.Scale]]:
    """What a person with a tape, and wheels, would say of the height (2,) of level."""
    height = rig.ceiling_height_m
    tape = height + rng.normal(0, float(np.hypot(scale.TAPE_M, scale.TAPE_FRACTION * height)))
    yield "height", scale.by_height(float(level[2]), sigma_m, tape)
    apart, turn = rng.uniform(*_APART_M), rng.uniform(0, np.pi)
    half = 0.5 * apart * np.array([np.cos(turn), np.sin(turn)])
    true = rig.mount_xy_m + np.array([half, -half])
    eye = np.array([*rig.mount_xy_m, -height])
    uv = rig.camera.pixels((np.column_stack([true, np.zeros(2)]) - eye) @ rig.camera_from_base.T)
    said = np.column_stack([true * (1.0 + rng.normal(0, scale.SPAN_M) / apart), np.zeros(2)])
    clicks = uv + rng.normal(0, scale.CLICK_PX, (2, 2))
    marks = scale.by_marks(rig.camera, level, [(said, clicks)], scale.CLICK_PX)
    if marks is not None:
        yield "marks", marks
    run = _RUN_M * float(level[2]) / height * (1.0 + rng.normal(0, _RUN_SIGMA))
    yield "wheels", scale.by_wheels(run, run / (_RUN_M * (1.0 + rng.normal(0, scale.WHEELS))), _RUN_SIGMA)


def summary(records: list[dict[str, Any]]) -> tuple[list[str], dict[str, dict[str, float]]]:
    """Lines of a table, and shares refused by tile and source."""
    total = sum(r["draws"] for r in records)
    shares = {t: {s: sum(r["by_tile"][t][s] for r in records) / total for s in SOURCES} for t in records[0]["by_tile"]}
    lines = [
        f"{len(records)} rigs, {total} draws of each; refused, %",
        f"  {'tile said':<10}" + "".join(f"{s:>8}" for s in SOURCES),
    ]
    lines += [f"  {t:<10}" + "".join(f"{100 * row[s]:>8.2f}" for s in SOURCES) for t, row in shares.items()]
    return lines, shares
