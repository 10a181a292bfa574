"""Is the scale right? A tile's side is one number that nothing on the ceiling contradicts: a second source must."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calibration import mount_rotation
from ceilvo.camera import CameraModel

Array = NDArray[np.float64]

SIGMAS = 3.0
"""Standard deviations that two sources may differ by."""
MOST = 0.03
"""A source that allows more decides nothing; chosen: tiles of 0.6 and 0.625 m, both are made, differ by 4 %."""
TAPE_M, TAPE_FRACTION = 0.010, 0.002
"""Sigma of a height by tape: where in the lens the camera is and how the ceiling hangs; and a tape out of plumb."""
SPAN_M = 0.002
"""Sigma of the way between two marks on the ceiling by tape; chosen: read to a millimetre at both ends."""
CLICK_PX, MARKER_PX = 0.5, 0.1
"""Sigma of a mark's place in the picture along each axis: clicked, and found as a marker."""
WHEELS = 0.008
"""Sigma of what the base takes for its wheels' diameter; chosen: load and wear change a tyre by up to two percent."""


@dataclass(frozen=True)
class Scale:
    """One source against the tile.

    Attributes:
        source: what it is.
        ratio: the length as the tile makes it over the source's, 1 = they agree.
        allowed: how far from 1 it may be.
        lengths: both, in words.
    """

    source: str
    ratio: float
    allowed: float
    lengths: str

    @property
    def agrees(self) -> bool:
        return abs(self.ratio - 1.0) <= self.allowed

    @property
    def decides(self) -> bool:
        return self.allowed <= MOST

    @property
    def confirms(self) -> bool:
        return self.agrees and self.decides

    @property
    def text(self) -> str:
        off = f"{self.lengths}: {100 * (self.ratio - 1.0):+.1f} %, {100 * self.allowed:.1f} allowed"
        return f"{self.source}: {off}" + ("" if self.decides or not self.agrees else ", which decides nothing")


def by_height(height_m: float, sigma_m: float, tape_m: float) -> Scale:
    """The ceiling above the camera as found and as measured with a tape."""
    allowed = SIGMAS * float(np.hypot(np.hypot(TAPE_M, TAPE_FRACTION * tape_m), sigma_m)) / tape_m
    lengths = f"the ceiling is at {height_m:.3f} m as found, {tape_m:.3f} m by tape"
    return Scale("height by tape", height_m / tape_m, allowed, lengths)


def by_marks(
    camera: CameraModel, level: Array, pictures: Sequence[tuple[Array, Array]], sigma_px: float
) -> Scale | None:
    """Marks on the ceiling, the way between which was measured; None when no picture shows two.

    Args:
        level: (3,) roll, pitch and height.
        pictures: of each, (N, 3) measured places and (N, 2) raw pixels of the marks in it; z is 0 on the ceiling.
        sigma_px: of a mark in a picture.
    """
    best: tuple[float, float, float, float] | None = None
    for xyz, uv in pictures:
        rays = camera.rays(uv) @ mount_rotation(0.0, level[0], level[1])
        seen = rays * ((level[2] + xyz[:, 2]) / rays[:, 2])[:, None]
        for i, j in itertools.combinations(range(len(xyz)), 2):
            tape = float(np.linalg.norm(xyz[i] - xyz[j]))
            if tape <= 0.0 or not np.isfinite(seen[[i, j]]).all():
                continue
            # a pixel is more on the ceiling where the camera looks at it aslant
            pixel = [level[2] / camera.fx_px * (np.linalg.norm(seen[k]) / level[2]) ** 2 for k in (i, j)]
            sigma = float(np.hypot(SPAN_M, sigma_px * np.hypot(*pixel))) / tape
            if best is None or sigma < best[0]:
                best = sigma, float(np.linalg.norm(seen[i] - seen[j])) / tape, tape, len(xyz)
    if best is None:
        return None
    sigma, ratio, tape, _ = best
    lengths = f"two marks are {ratio * tape:.3f} m apart as found, {tape:.3f} m by tape"
    return Scale("two marks", ratio, SIGMAS * sigma, lengths)


def by_wheels(run_m: float, wheel_scale: float, sigma: float) -> Scale:
    """The straight run of the mount as the ceiling shows it and as the wheels report it.

    Args:
        wheel_scale: true over reported way, and its sigma.
    """
    allowed = SIGMAS * float(np.hypot(WHEELS, sigma))
    lengths = f"the run is {run_m:.3f} m as found, {run_m / wheel_scale:.3f} m by the wheels"
    return Scale("wheels", wheel_scale, allowed, lengths)


def problem(scale: Scale, tile_m: float | None) -> str:
    """Why the two do not go together, with both figures and what to do; "" when they do."""
    if scale.agrees:
        return ""
    if tile_m is None:
        return f"{scale.text}; measure both again"
    return (
        f"the tile of {tile_m:g} m and the {scale.source} disagree: {scale.lengths}, {_off(scale)}; by the "
        f"{scale.source} a tile has {tile_m / scale.ratio:.3f} m: measure ten tiles in a row, joint to joint, and "
        + ("the wheels' diameter; --height-m tells who is right" if scale.source == "wheels" else "the other once more")
    )


def _off(scale: Scale) -> str:
    return f"{100 * (scale.ratio - 1.0):+.1f} %, {100 * scale.allowed:.1f} allowed"


def kept(scales: Sequence[Scale]) -> list[dict[str, Any]]:
    """As a step's result has them."""
    return [asdict(s) for s in scales]


def tile_alone(tile_m: float) -> str:
    """What a person is told whose scale nothing confirms."""
    return (
        f"scale unconfirmed: it comes from the tile of {tile_m:g} m alone; confirm it by a tape ('calib projection "
        "--height-m'), by two marks (--marks) or by the wheels ('calib mount' with a base)"
    )


def read(result: Mapping[str, Any] | None) -> list[Scale]:
    """The sources that a step's result has.

    Raises:
        TypeError, LookupError, ValueError: it is not as kept() wrote it.
    """
    if result is None:
        return []
    return [
        Scale(str(s["source"]), float(s["ratio"]), float(s["allowed"]), str(s["lengths"]))
        for s in result.get("scale", [])
    ]


def of_session(projection: Mapping[str, Any], mount: Mapping[str, Any] | None) -> tuple[dict[str, Any], str]:
    """`meta.scale` of the calibration, and what is to be done about it, "" when nothing is.

    Points that were measured one by one are lengths by tape already; a mount under another tile says nothing.
    """
    tile_m, scales = projection.get("tile_m"), read(projection)
    stale = mount is not None and read(mount) and mount.get("tile_m") != tile_m
    if mount is not None and not stale:
        scales += read(mount)
    state, texts = summary(scales)
    if tile_m is None and state == "unconfirmed":
        state, texts = "confirmed", [*texts, "measured points"]
    to_do = ""
    if state == "unconfirmed" and tile_m is not None:
        to_do = tile_alone(float(tile_m)) + (
            "; the wheels' run was of another tile: 'calib mount --force'" if stale else ""
        )
    elif state == "contradicted":
        to_do = "scale contradicted: " + "; ".join(problem(s, tile_m) for s in scales if not s.agrees)
    return {"state": state, "sources": texts}, to_do


def summary(scales: Sequence[Scale]) -> tuple[str, list[str]]:
    """ "confirmed", "unconfirmed" or "contradicted", and what each source says.

    Wheels that differ where a tape agrees are the wheels' own matter.
    """
    texts = [s.text for s in scales]
    measured = [s for s in scales if s.source != "wheels"]
    if any(s.confirms for s in measured) and all(s.agrees for s in measured):
        return "confirmed", texts
    if not all(s.agrees for s in scales):
        return "contradicted", texts
    return ("confirmed" if any(s.confirms for s in scales) else "unconfirmed"), texts
