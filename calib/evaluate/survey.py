"""How good a ceiling is for the daemon: features, ambiguity, dark spots, flicker, on a map of where the robot was."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calibration import Calibration, in_base
from ceilvo.daemon.integrity.staleness import MIN_UPDATES
from ceilvo.robust import MAD_TO_SIGMA
from ceilvo.types import Crossings, Estimate

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

CELL_M = 0.5
"""Side of the map's places; chosen: about a tile."""
FEW_CROSSINGS = 8.0
"""In view, median of a place; chosen."""
DARK_LEVEL = 25.0
"""Grey level, median of a place; chosen: a tenth of the range."""
AMBIGUOUS = 0.9
"""Of what is in view, that looks the same one tile on; under the simulated ceiling it is 0.76 (docs/calibration.md)."""
FLICKER = 0.01
"""Ripple over mean that counts; chosen: 1 %."""
HIGHEST_NIS = 6.0
"""With good calibrations the mean was 0.4 to 4, by rig and ceiling (docs/calibration.md)."""
_MATCH_M = 0.05
"""Within which two crossings are the same."""
_MAINS = ((50.0, 10_000), (60.0, 8_333))
"""Hz, and the exposure in us that one half-period of it takes."""
_OUTLINE = (17, 13)
"""Pixels across and down from which the part of the ceiling in view is outlined."""
_NEAR = 1.5
"""Times the ceiling's height, up to which crossings are counted: beyond 56 deg off the vertical few are found."""
_POOR_PLACES, _FAILED = 0.1, 0.05
"""Fractions of places with few crossings or little light, and of frames without motion, that are allowed; chosen."""
_MIN_FRAMES = 16
"""For flicker: two smoothing windows."""
_NOISE_SIGMAS = 4.0
"""By which a ripple must stand out of the frames' own noise."""
_SLOW = 0.08
"""Of the frame rate: a slower alias cannot be told from driving under another lamp."""
_NEIGHBOURS = 9
"""Frames of the running median that is taken off."""


@dataclass
class Cell:
    """What was met while the robot was in one cell."""

    crossings: list[float] = field(default_factory=list)
    level: list[float] = field(default_factory=list)
    failed: int = 0
    frames: int = 0


@dataclass(frozen=True)
class Flicker:
    """Relative amplitude of the light's ripple; mains_hz 0 = none seen; exposures that average it out, us."""

    amplitude: float
    mains_hz: float
    exposures_us: tuple[int, ...]
    visible: bool

    @property
    def text(self) -> str:
        if not self.visible:
            return "cannot be seen: fewer than 16 frames, or a frame rate that the mains' ripple falls together with"
        if not self.mains_hz:
            return f"none ({100 * self.amplitude:.2f} % ripple)"
        return (
            f"{100 * self.amplitude:.1f} % ripple of {self.mains_hz:.0f} Hz mains: expose for "
            f"{' or '.join(str(e) for e in self.exposures_us)} us"
        )


class Survey:
    """Takes frames with the daemon's estimate for each."""

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self.cells: dict[tuple[int, int], Cell] = {}
        self.path: list[Array] = []
        self.densities: list[float] = []
        self.ambiguities: list[float] = []
        self.light: list[tuple[float, float]] = []
        self.nis: list[tuple[float, float]] = []
        camera = calibration.camera
        x, y = np.linspace(0, camera.width_px - 1, _OUTLINE[0]), np.linspace(0, camera.height_px - 1, _OUTLINE[1])
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        on_ceiling = in_base(calibration, grid)
        near = np.hypot(*(on_ceiling - calibration.mount_xy_m).T) < _NEAR * calibration.ceiling_height_m
        hull = cv2.convexHull(on_ceiling[near].astype(np.float32))
        self._seen_m2 = max(float(cv2.contourArea(hull)), 1e-3)
        self._reach_m = float(np.hypot(*(on_ceiling[near] - calibration.mount_xy_m).T).max())

    def add(self, gray: Gray, estimate: Estimate, crossings: Crossings | None, motion_ok: bool) -> None:
        """One frame: the daemon's estimate, what the front end found, whether it gave a motion."""
        pose = estimate.pose
        key = (int(np.floor(pose[0] / CELL_M)), int(np.floor(pose[1] / CELL_M)))
        cell = self.cells.setdefault(key, Cell())
        n = 0 if crossings is None else len(crossings)
        level = float(np.median(gray[::4, ::4]))
        cell.crossings.append(float(n))
        cell.level.append(level)
        cell.frames += 1
        cell.failed += int(not motion_ok)
        self.path.append(pose)
        self.light.append((1e-9 * estimate.stamp_ns, level))
        if estimate.health.nis_dof > 0 and np.isfinite(estimate.health.nis):
            self.nis.append((1e-9 * estimate.stamp_ns, estimate.health.nis))
        if crossings is not None and n:
            r = np.hypot(*(crossings.xy_base_m - self._calibration.mount_xy_m).T)
            self.densities.append(float(np.sum(r <= self._reach_m)) / self._seen_m2)
            if self._calibration.tile_m:
                self.ambiguities.append(ambiguity(crossings, self._calibration.tile_m))

    @property
    def mean_nis(self) -> float | None:
        """Of the filter's updates, per degree of freedom; None after too few of them."""
        return float(np.mean([n for _, n in self.nis])) if len(self.nis) >= MIN_UPDATES else None

    @property
    def density(self) -> float:
        """Crossings a square metre, median of the frames."""
        return float(np.median(self.densities)) if self.densities else 0.0

    @property
    def ambiguity(self) -> float:
        """Median of the frames, 0 where the tile is unknown."""
        return float(np.median(self.ambiguities)) if self.ambiguities else 0.0

    @property
    def failed(self) -> float:
        frames = sum(c.frames for c in self.cells.values())
        return sum(c.failed for c in self.cells.values()) / max(frames, 1)

    def poor(self) -> list[tuple[int, int]]:
        return [k for k, c in self.cells.items() if np.median(c.crossings) < FEW_CROSSINGS]

    def dark(self) -> list[tuple[int, int]]:
        return [k for k, c in self.cells.items() if np.median(c.level) < DARK_LEVEL]

    def problems(self) -> list[str]:
        """What keeps the ceiling from a PASS, with what to do."""
        out = []
        n = max(len(self.cells), 1)
        if len(self.poor()) > _POOR_PLACES * n:
            out.append(
                f"{len(self.poor())} of {n} places have fewer than {FEW_CROSSINGS:.0f} crossings in view: "
                "more light, a wider lens, or let the wheels bridge them (red on the map)"
            )
        if len(self.dark()) > _POOR_PLACES * n:
            out.append(f"{len(self.dark())} of {n} places are dark: a longer exposure or light (blue on the map)")
        if self.failed > _FAILED:
            out.append(f"vision failed in {100 * self.failed:.0f} % of the frames, 5 allowed: drive slower, more light")
        if self.mean_nis is not None and self.mean_nis > HIGHEST_NIS:
            out.append(
                f"NIS is {self.mean_nis:.1f} per degree of freedom, at most {HIGHEST_NIS:g} expected: "
                "lens or projection do not describe this camera; run 'calib check'"
            )
        return out

    def notes(self) -> list[str]:
        out = []
        if self.ambiguity > AMBIGUOUS:
            out.append(
                f"the ceiling repeats itself ({100 * self.ambiguity:.0f} % of what is seen is the same one tile on): "
                "keep base.use_wheels on, and the frame rate above 2 x speed / tile"
            )
        return out

    def picture(self, px_per_cell: int = 48) -> NDArray[np.uint8]:
        """(H, W, 3) map: green good, red few crossings, blue dark; the path in white; north is +y."""
        keys = np.array(list(self.cells) or [(0, 0)])
        low, high = keys.min(axis=0) - 1, keys.max(axis=0) + 2
        w, h = (high - low) * px_per_cell
        image = np.full((int(h), int(w), 3), 40, np.uint8)
        for (i, j), c in self.cells.items():
            x, y = (i - low[0]) * px_per_cell, (high[1] - 1 - j) * px_per_cell
            richness = min(float(np.median(c.crossings)) / (3 * FEW_CROSSINGS), 1.0)
            colour = (40, int(60 + 140 * richness), int(200 * (1 - richness)))
            if np.median(c.level) < DARK_LEVEL:
                colour = (200, 80, 40)
            cv2.rectangle(image, (int(x), int(y)), (int(x + px_per_cell - 2), int(y + px_per_cell - 2)), colour, -1)
            text = f"{np.median(c.crossings):.0f}"
            cv2.putText(
                image, text, (int(x) + 5, int(y) + px_per_cell - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255,) * 3, 1
            )
        if len(self.path) > 1:
            p = np.array(self.path)[:, :2] / CELL_M
            uv = np.column_stack([(p[:, 0] - low[0]) * px_per_cell, (high[1] - p[:, 1]) * px_per_cell])
            cv2.polylines(
                image, [np.round(uv).astype(np.int32).reshape(-1, 1, 2)], False, (255, 255, 255), 1, cv2.LINE_AA
            )
        return image


def ambiguity(crossings: Crossings, tile_m: float) -> float:
    """Share of crossings that have one of their kind a tile on, where that is most; 1 = a pure grid."""
    xy, kind = crossings.xy_base_m, crossings.crossing_type
    low, high = xy.min(axis=0) - _MATCH_M, xy.max(axis=0) + _MATCH_M
    worst = 0.0
    for k in range(4):
        shift = se2.rotation(crossings.psi_rad + 0.5 * np.pi * k) @ np.array([tile_m, 0.0])
        moved = xy + shift
        inside = ((moved > low) & (moved < high)).all(axis=1)
        if np.count_nonzero(inside) < 4:
            continue
        d = np.hypot(*(moved[inside][:, None] - xy[None]).transpose(2, 0, 1))
        d[kind[inside][:, None] != kind[None, :]] = np.inf
        worst = max(worst, float(np.mean(d.min(axis=1) < _MATCH_M)))
    return worst


def flicker(light: list[tuple[float, float]]) -> Flicker:
    """From (time s, grey level) of consecutive frames; ripple at twice the mains shows at its alias."""
    t = np.array([a for a, _ in light])
    y = np.array([b for _, b in light])
    if len(t) < _MIN_FRAMES or np.ptp(t) <= 0:
        return Flicker(0.0, 0.0, (), False)
    rate = 1.0 / float(np.median(np.diff(t)))
    ripple = y / np.maximum(_smooth(y), 1.0) - 1.0
    best, mains, visible = 0.0, 0.0, False
    noise = MAD_TO_SIGMA * float(np.median(np.abs(ripple))) * np.sqrt(2.0 / len(y)) * _NOISE_SIGMAS
    for hz, _ in _MAINS:
        alias = abs(2 * hz - rate * round(2 * hz / rate))
        if alias < _SLOW * rate:
            continue
        visible = True
        a = 2.0 * abs(np.mean(ripple * np.exp(-2j * np.pi * 2 * hz * t)))
        if a > best:
            best, mains = a, hz
    seen = best > max(FLICKER, noise)
    us = dict(_MAINS)[mains] if seen else 0
    return Flicker(best, mains if seen else 0.0, (us, 2 * us) if us else (), visible)


def _smooth(y: Array) -> Array:
    """Median of _NEIGHBOURS."""
    padded = np.pad(y, _NEIGHBOURS // 2, mode="edge")
    return np.median(np.lib.stride_tricks.sliding_window_view(padded, _NEIGHBOURS), axis=1)
