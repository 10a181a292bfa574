"""Figures of merit against the simulator's exact truth.

Crossings are compared in the level view of the calibration that the pipeline was given, tilt taken out, so that an
error of the calibration or of the estimated tilt counts as an error of the crossing.

- recall: true grid crossings (four arms or three) and corners of lit lamps whose image is inside the frame by
  `MARGIN_PX`, not hidden and at most 50 deg off the vertical (a fisheye shows an 8 mm groove beyond that as a third
  of a pixel); found = a crossing reported within `FOUND_PX`.
- precision: reported crossings within `FOUND_PX` of a place where two true lines (grooves, lamp and vent edges) meet.
- error: distance from a found true grid crossing to the nearest report. Corners of lamps have an error of their own: a
  lamp saturates the sensor, so its edge is seen more than a pixel outside of where it is.
- Where the pipeline is given a wrong calibration, all crossings are off by it: `FOUND_WRONG_CALIBRATION_PX` instead.
- motion: a good motion against the true one since the last good frame; NEES of the same with the motion's covariance.
- drift: worst position error of the integrated motions over the path's length.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ceilvo import se2
from ceilvo.calibration import USUAL_FOCAL_PX, Calibration
from ceilvo.sim.ceiling.layout import CrossingType
from ceilvo.sim.world import World
from ceilvo.types import Crossings, Motion

Array = NDArray[np.float64]

MARGIN_PX = 14.0  # docs/bench.md (recall); chosen: a crossing nearer the border lacks an arm
# All px are those of a camera with USUAL_FOCAL_PX, and as large an angle for others.
FOUND_PX = 3.0  # docs/bench.md (recall, precision); chosen, far above the error and far below a tile
FOUND_WRONG_CALIBRATION_PX = 6.0  # docs/bench.md; twice the p95 of mixed-cal, 3 px
WRONG_M = 0.02  # docs/bench.md (wrong)
_CLEAR_PX = 14  # from what hides; as MARGIN_PX
_STEEPEST_DEG = 50.0  # off the vertical; see above


@dataclass
class CrossingScore:
    """Counts and errors of crossings, frame after frame."""

    world: World
    calibration: Calibration
    found: int = 0
    missed: int = 0
    right: int = 0
    wrong: int = 0
    lamps_found: int = 0
    lamps_missed: int = 0
    errors_px: list[Array] = field(default_factory=list)
    lamp_errors_px: list[Array] = field(default_factory=list)
    recall_per_frame: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        found_px = FOUND_PX if self.calibration is self.world.calibration else FOUND_WRONG_CALIBRATION_PX
        self._found_px = found_px * self.calibration.level_view.focal_px / USUAL_FOCAL_PX
        self._raw_scale = self.world.calibration.camera.focal_px / USUAL_FOCAL_PX
        xy, crossing_type = self.world.ceiling.true_crossings()
        render = self.world.spec.render
        lamps_seen = render.lit is None and render.switch_groups == 0
        wanted = (crossing_type == CrossingType.CROSS) | (crossing_type == CrossingType.TEE)
        if lamps_seen:
            wanted |= crossing_type == CrossingType.LAMP
        self._true = xy[wanted]
        self._is_lamp = crossing_type[wanted] == CrossingType.LAMP
        self._plausible = np.concatenate([self.world.ceiling.true_intersections(), self._wall_meetings()])

    def add(self, crossings: Crossings | None, pose: Array, tilt: Array) -> None:
        """Score one frame seen from a true pose (3,) with a true tilt (2,)."""
        shown = self._visible(pose, tilt)
        true_uv = self._level(self._true[shown], pose)
        uv = crossings.uv_px if crossings is not None else np.zeros((0, 2))
        nearest = _nearest(true_uv, uv)
        good = nearest < self._found_px
        self.found += int(good.sum())
        self.missed += int((~good).sum())
        lamp = self._is_lamp[shown]
        self.errors_px.append(nearest[good & ~lamp])
        self.lamp_errors_px.append(nearest[good & lamp])
        self.lamps_found += int((good & lamp).sum())
        self.lamps_missed += int((~good & lamp).sum())
        if len(good):
            self.recall_per_frame.append(float(good.mean()))
        near = np.hypot(*(self._plausible - pose[:2]).T) < 6.0
        ok = _nearest(uv, self._level(self._plausible[near], pose)) < self._found_px
        self.right += int(ok.sum())
        self.wrong += int((~ok).sum())

    def figures(self) -> dict[str, float]:
        errors, lamps = (
            np.concatenate(self.errors_px or [np.zeros(0)]),
            np.concatenate(self.lamp_errors_px or [np.zeros(0)]),
        )
        frames = max(len(self.errors_px), 1)
        return {
            "recall_pct": percent(self.found, self.missed),
            "recall_grid_pct": percent(self.found - self.lamps_found, self.missed - self.lamps_missed),
            "recall_lamps_pct": percent(self.lamps_found, self.lamps_missed),
            "precision_pct": percent(self.right, self.wrong),
            "crossing_median_px": _quantile(errors, 0.5),
            "crossing_p95_px": _quantile(errors, 0.95),
            "lamp_corner_p95_px": _quantile(lamps, 0.95),
            "crossings_true_per_frame": (self.found + self.missed) / frames,
            "crossings_reported_per_frame": (self.right + self.wrong) / frames,
            "recall_worst_frame_pct": 100.0 * min(self.recall_per_frame, default=float("nan")),
        }

    def _level(self, xy_map: Array, pose: Array) -> Array:
        base = se2.transform(se2.inverse(pose), xy_map)
        s = np.column_stack([base, np.ones(len(base))]) @ self.calibration.level_from_ceiling.T
        return np.asarray(s[:, :2] / s[:, 2:])

    def _visible(self, pose: Array, tilt: Array) -> NDArray[np.bool_]:
        """Which true crossings are in the picture, by the true calibration and the true tilt, and not hidden."""
        true = self.world.calibration
        base = se2.transform(se2.inverse(pose), self._true) - true.mount_xy_m
        ray = np.column_stack([base / true.ceiling_height_m, np.ones(len(base))])
        steep = np.hypot(ray[:, 0], ray[:, 1]) > np.tan(np.radians(_STEEPEST_DEG))
        seen = ray @ cv2.Rodrigues(np.array([tilt[0], tilt[1], 0.0]))[0]  # transposed: base_from_tilted is R
        uv = true.camera.pixels(seen @ true.camera_from_base.T)
        cam = true.camera
        with np.errstate(invalid="ignore"):
            margin = MARGIN_PX * self._raw_scale
            inside = np.all((uv > margin) & (uv < [cam.width_px - 1 - margin, cam.height_px - 1 - margin]), 1)
        inside &= ~steep
        surroundings = self.world.spec.surroundings
        if surroundings.slabs or surroundings.boxes or surroundings.walls:
            clear = round(_CLEAR_PX * self._raw_scale)
            hidden = cv2.dilate(self.world.renderer.occlusion(pose, tilt), np.ones((2 * clear + 1,) * 2)) > 0.02
            at = np.rint(uv[inside]).astype(np.int64)
            inside[inside] = ~hidden[at[:, 1], at[:, 0]]
        return np.asarray(inside)

    def _wall_meetings(self) -> Array:
        """Where the ceiling's lines run into a wall, and the corners of the room: real features at ceiling height."""
        if not self.world.spec.surroundings.walls:
            return np.zeros((0, 2))
        side = self.world.spec.lap.room_m
        lines = self.world.ceiling.true_lines()
        out = [np.array([[0.0, 0.0], [0.0, side], [side, 0.0], [side, side]])]
        for axis in (0, 1):
            at = np.unique(np.round(lines.segments[lines.axis == axis][:, 0, axis], 6))
            for wall in (0.0, side):
                out.append(np.column_stack([at, np.full(len(at), wall)])[:, :: 1 if axis == 0 else -1])
        return np.concatenate(out)


class MotionScore:
    """Motions against truth, and the path they add up to."""

    def __init__(self, start: Array) -> None:
        self._pose = np.array(start, np.float64)
        self._anchor_true = np.array(start, np.float64)
        self._since = np.zeros(3)
        self._started = False
        self.errors: list[Array] = []
        self.nees: list[float] = []
        self.failures: dict[str, int] = {}
        self.frames = self.wrong = self.restarts = 0
        self.position_errors_m: list[float] = []
        self.heading_errors_rad: list[float] = []
        self.wrong_at: list[int] = []

    def add(self, motion: Motion, true: Array) -> None:
        """One frame's motion and the true pose (3,) at its time."""
        self.frames += 1
        self._pose = se2.compose(self._pose, motion.prev_from_curr)
        self._since = se2.compose(self._since, motion.prev_from_curr)
        if not motion.ok and self._started:
            first = "".join(c for c in str(motion.failure) if not c.isdigit())
            self.failures[first] = self.failures.get(first, 0) + 1
        elif motion.ok:
            self._judge(motion, se2.between(self._anchor_true, true))
        if motion.ok or motion.restarted:
            self.restarts += self._started and motion.restarted
            self._anchor_true, self._since, self._started = true, np.zeros(3), True
        self.position_errors_m.append(float(np.hypot(*(self._pose - true)[:2])))
        self.heading_errors_rad.append(abs(se2.wrap(float(self._pose[2] - true[2]))))

    def _judge(self, motion: Motion, true_motion: Array) -> None:
        error = self._since - true_motion
        error[2] = se2.wrap(float(error[2]))
        self.errors.append(error)
        self.nees.append(float(error @ np.linalg.solve(motion.cov, error)))
        if float(np.hypot(error[0], error[1])) > WRONG_M:
            self.wrong += 1
            self.wrong_at.append(self.frames - 1)

    def figures(self, path_m: float) -> dict[str, float]:
        errors = np.array(self.errors).reshape(-1, 3)
        xy = 1e3 * np.hypot(errors[:, 0], errors[:, 1])
        turn = 1e3 * np.degrees(np.abs(errors[:, 2]))
        worst_m = max(self.position_errors_m, default=float("nan"))
        nees = np.array(self.nees)
        return {
            "motion_median_mm": _quantile(xy, 0.5),
            "motion_p95_mm": _quantile(xy, 0.95),
            "motion_max_mm": float(xy.max(initial=0.0)),
            "motion_median_mdeg": _quantile(turn, 0.5),
            "motion_p95_mdeg": _quantile(turn, 0.95),
            "worst_mm": 1e3 * worst_m,
            "final_mm": 1e3 * self.position_errors_m[-1],
            "drift_pct": 100.0 * worst_m / path_m if path_m > 0 else float("nan"),
            "heading_deg": float(np.degrees(self.heading_errors_rad[-1])),
            "nees_mean": float(nees.mean()) / 3.0 if len(nees) else float("nan"),
            "nees_median": _quantile(nees, 0.5) / 2.366,  # the median of chi squared with 3 degrees of freedom
            "failed": float(sum(self.failures.values())),
            "restarts": float(self.restarts),
            "wrong": float(self.wrong),
        }


def _nearest(a: Array, b: Array) -> Array:
    """(len(a),) distance to the nearest of b; infinite without any."""
    if len(a) == 0 or len(b) == 0:
        return np.full(len(a), np.inf)
    return np.asarray(cKDTree(b).query(a)[0])


def percent(good: int, bad: int) -> float:
    """Share of the good ones; nan without any."""
    return 100.0 * good / (good + bad) if good + bad else float("nan")


def _quantile(values: Array, q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")
