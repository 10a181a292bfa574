"""Pictures of the pipeline at work: what was found drawn on the frame, and the particles seen from above."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.camera import LevelView
from ceilvo.crossing_types import LINE_CROSSINGS
from ceilvo.types import Crossings, LineKind, Lines, Motion

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

# Okabe and Ito's palette, told apart by colour-blind readers too (BGR)
ORANGE: Colour = (0, 159, 230)
SKY: Colour = (233, 180, 86)
GREEN: Colour = (115, 158, 0)
YELLOW: Colour = (66, 228, 240)
BLUE: Colour = (178, 114, 0)
VERMILION: Colour = (0, 94, 213)
PURPLE: Colour = (167, 121, 204)
WHITE: Colour = (255, 255, 255)
DARK: Colour = (40, 34, 30)
GREY: Colour = (130, 125, 120)

_AXIS_COLOURS = (ORANGE, SKY)
_GRID: Colour = (62, 56, 52)
# sizes in pixels of the picture before it is enlarged, all chosen by eye at 640x480
_DIMMED = 0.7  # of the frame's brightness, so that what is drawn stands out
_DISC_PX, _POLYGON_PX = 3.5, 4.5  # radii of crossings
_SHORTEST_ARROW_PX = 1.5  # a shorter motion is not drawn
_HEAD_PX, _HEAD_PER_THICKNESS, _LONGEST_HEAD, _HEAD_SLOPE = 2.0, 2.5, 0.6, 0.55  # fraction of the arrow; half width
_DIRECTION_PX = 60.0  # arrows of the dominant directions
_FONT_SIZE = 0.42  # of cv2's Hershey font: 9 px
_LANDMARK_PX, _TRUTH_PX, _PARTICLE_PX, _HEADING_PX = 2.0, 7.0, 1.3, 7.0  # radii, and the length of a heading
_FAINTEST = 0.35  # of a particle's colour, for those of no weight
_ROBOT_PX = np.array([[11.0, 0.0], [-7.0, 6.5], [-3.5, 0.0], [-7.0, -6.5], [11.0, 0.0]])  # an arrow head
_MOST_GRID_LINES = 12.0  # across the panel; more would hide what is drawn
_FINEST_GRID_M = 1e-2  # finer lines are finer than what is shown
_PANEL_MARGIN_M = 0.3  # around path and landmarks
_ELLIPSE_SIGMAS, _ELLIPSE_POINTS = 2.0, 25  # about 86 % of a Gaussian in the plane

_STEP_PX = 4.0
"""Between points of a line that is drawn as a curve; chosen: lenses bend lines by less than a pixel over it."""
_SUPPORT_PX, _SUPPORT_POINTS = 10.0, 4
"""A line is drawn where so many of its edge points lie this near; chosen: gaps of lamps and grooves show."""
_INVERTIBLE_PX = 1.0
"""The lens sees a level pixel that comes back to within this; chosen: folds are off by far more."""
_SUBPIXEL_BITS = 4
"""Of cv2's fixed-point coordinates: 1/16 px."""
_MARGIN_PX = 2000.0
"""What is further outside is not drawn; chosen: cv2's 32-bit coordinates hold it, whatever the scale."""


def draw_overlay(
    gray: Image,
    lines: Lines | None,
    crossings: Crossings | None,
    level_view: LevelView,
    previous_uv_px: Array | None = None,
    scale: int = 1,
) -> Image:
    """The frame with lines (axis 0 orange, axis 1 blue; grooves thick), crossings by kind and the dominant direction.

    Args:
        gray: (H, W) of the calibrated size.
        previous_uv_px: (M, 2) where each crossing was in the previous frame, level pixels (previous_pixels).
        scale: whole-number enlargement of the picture.

    Returns:
        (scale H, scale W, 3) BGR.
    """
    image = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR) * _DIMMED, np.uint8)
    canvas = Canvas(np.repeat(np.repeat(image, scale, axis=0), scale, axis=1), scale)
    if lines is not None:
        for k in range(len(lines.axis)):
            thickness = 2 if lines.kind[k] == LineKind.GROOVE else 1
            canvas.curve(line_in_raw(lines, k, level_view), _AXIS_COLOURS[int(lines.axis[k])], thickness * scale)
    if crossings is not None and len(crossings):
        here = tilted(crossings.uv_px, crossings.tilt_rad, level_view)
        if previous_uv_px is not None:
            before = tilted(previous_uv_px, crossings.tilt_rad, level_view)
            _draw_motion(canvas, level_view.to_raw(before), level_view.to_raw(here))
        for uv, kind in zip(level_view.to_raw(here), crossings.crossing_type, strict=True):
            _draw_crossing(canvas, uv, int(kind))
    if lines is not None:
        _draw_direction(canvas, lines, level_view)
    return canvas.image


def line_in_raw(lines: Lines, index: int, level_view: LevelView) -> Array:
    """(K, 2) raw pixels along one line, every few pixels; a curve where the lens bends it.

    From the first to the last edge point that supports it, nan where there are few near and where the lens cannot
    see. Without any edge points the line is followed across the whole view.
    """
    angle = lines.psi_rad + 0.5 * np.pi * int(lines.axis[index])
    normal, along = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    mine = lines.points[lines.point_line == index] @ along
    reach = float(np.hypot(level_view.camera.width_px, level_view.camera.height_px))
    low, high = (float(mine.min()), float(mine.max())) if len(mine) else (-reach, reach)
    at = np.linspace(low, high, max(int((high - low) / _STEP_PX), 1) + 1)
    level = lines.offset_px[index] * normal + at[:, None] * along + _principal_point(level_view)
    seen = tilted(level, lines.tilt_rad, level_view)
    raw = level_view.to_raw(seen)
    with np.errstate(invalid="ignore"):
        # past the edge of the lens model its polynomial folds back into the picture
        bad = ~(np.abs(level_view.from_raw(np.nan_to_num(raw)) - seen).max(axis=1) < _INVERTIBLE_PX)
    if len(mine):
        bad |= _support(np.sort(mine), at) < _SUPPORT_POINTS
    raw[bad] = np.nan
    return raw


def _support(sorted_values: Array, at: Array) -> NDArray[np.int64]:
    """How many values lie within reach of each of `at`."""
    high = np.searchsorted(sorted_values, at + _SUPPORT_PX)
    return np.asarray(high - np.searchsorted(sorted_values, at - _SUPPORT_PX), np.int64)


def tilted(uv_level_px: Array, tilt_rad: Array, level_view: LevelView) -> Array:
    """(N, 2) level pixels as the tilted robot saw them; lines and crossings are given as a level robot would."""
    f, centre = level_view.focal_px, _principal_point(level_view)
    a, b = float(tilt_rad[0]), float(tilt_rad[1])
    level_from_seen = np.array([[1.0, 0.0, b], [0.0, 1.0, -a], [-b, a, 1.0]])
    rays = np.column_stack([(np.asarray(uv_level_px, np.float64) - centre) / f, np.ones(len(uv_level_px))])
    seen = rays @ np.linalg.inv(level_from_seen).T
    return np.asarray(seen[:, :2] / seen[:, 2:] * f + centre, np.float64)


def previous_pixels(crossings: Crossings, motion: Motion, calibration: Calibration) -> Array:
    """(M, 2) level pixels where the crossings were in the previous frame."""
    before = se2.transform(motion.prev_from_curr, crossings.xy_base_m)
    level = np.column_stack([before, np.ones(len(before))]) @ calibration.level_from_ceiling.T  # eq. 6
    return np.asarray(level[:, :2] / level[:, 2:], np.float64)


def _principal_point(level_view: LevelView) -> Array:
    return np.array([level_view.camera.cx_px, level_view.camera.cy_px])


class Canvas:
    """Anti-aliased drawing with sub-pixel coordinates on an enlarged picture; nan and far-away points are left out."""

    def __init__(self, image: Image, scale: int = 1) -> None:
        self.image = image
        self._scale = scale

    def _fixed(self, uv: Array) -> NDArray[np.int32]:
        """Pixel centres are at whole coordinates, before and after enlarging."""
        scaled = (np.asarray(uv, np.float64) + 0.5) * self._scale - 0.5
        return np.asarray(np.rint(scaled * (1 << _SUBPIXEL_BITS)), np.int32)

    def _usable(self, uv: Array) -> NDArray[np.bool_]:
        """cv2 draws with 32-bit coordinates: what is far outside must not reach it."""
        h, w = self.image.shape[:2]
        with np.errstate(invalid="ignore"):
            low = np.all(uv * self._scale > -_MARGIN_PX, axis=-1)
            return np.asarray(low & np.all(uv * self._scale < max(h, w) + _MARGIN_PX, axis=-1))

    def curve(self, uv: Array, colour: Colour, thickness: int = 1) -> None:
        ok = self._usable(uv)
        for run in np.split(np.arange(len(uv)), np.flatnonzero(np.diff(ok)) + 1):
            if len(run) > 1 and ok[run[0]]:
                points = self._fixed(uv[run]).reshape(-1, 1, 2)
                cv2.polylines(self.image, [points], False, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)

    def disc(self, uv: Array, radius_px: float, colour: Colour, thickness: int = -1) -> None:
        if self._usable(uv):
            x, y = self._fixed(uv).tolist()
            radius = round(radius_px * self._scale * (1 << _SUBPIXEL_BITS))
            width = thickness if thickness < 0 else thickness * self._scale
            cv2.circle(self.image, (x, y), radius, colour, width, cv2.LINE_AA, _SUBPIXEL_BITS)

    def polygon(self, uv: Array, colour: Colour) -> None:
        if self._usable(uv).all():
            cv2.fillPoly(self.image, [self._fixed(uv).reshape(-1, 1, 2)], colour, cv2.LINE_AA, _SUBPIXEL_BITS)

    def arrow(self, tail: Array, tip: Array, colour: Colour, thickness: int = 1) -> None:
        """A line with a filled head; very short ones are left out."""
        d = np.asarray(tip - tail, np.float64)
        length = float(np.hypot(*d))
        if not length > _SHORTEST_ARROW_PX:
            return
        u, n = d / length, np.array([-d[1], d[0]]) / length
        head = min(_HEAD_PX + _HEAD_PER_THICKNESS * thickness, _LONGEST_HEAD * length)
        self.curve(np.stack([tail, tip - head * u]), colour, thickness * self._scale)
        wide = _HEAD_SLOPE * n
        self.polygon(np.stack([tip, tip - head * (u + wide), tip - head * (u - wide)]), colour)

    def text(self, x: int, y: int, text: str, colour: Colour = WHITE) -> None:
        """On a dark plate, so that it reads on any background; (x, y) is its left baseline."""
        font, size, n = cv2.FONT_HERSHEY_SIMPLEX, _FONT_SIZE * self._scale, self._scale
        (width, height), below = cv2.getTextSize(text, font, size, n)
        corners = (x * n - 3 * n, y * n - height - 3 * n), (x * n + width + 3 * n, y * n + below)
        cv2.rectangle(self.image, *corners, DARK, -1)
        cv2.putText(self.image, text, (x * n, y * n), font, size, colour, n, cv2.LINE_AA)


def _draw_crossing(canvas: Canvas, uv: Array, kind: int) -> None:
    """Disc: groove with groove. Triangle: groove with edge. Square: two edges, as a lamp's corner. Purple: a point."""
    edges = int(kind // 3 != 1) + int(kind % 3 != 1) if kind < LINE_CROSSINGS else 0
    colour = (GREEN, YELLOW, VERMILION)[edges] if kind < LINE_CROSSINGS else PURPLE
    if edges == 0:
        canvas.disc(uv, _DISC_PX, colour)
    else:
        angle = np.arange(2 + edges) * 2.0 * np.pi / (2 + edges) + (0.25 * np.pi if edges == 2 else -0.5 * np.pi)
        canvas.polygon(uv + _POLYGON_PX * np.column_stack([np.cos(angle), np.sin(angle)]), colour)


def _draw_motion(canvas: Canvas, before: Array, here: Array) -> None:
    for tail, tip in zip(before, here, strict=True):
        if np.all(np.isfinite(tail)) and np.all(np.isfinite(tip)):
            canvas.arrow(tail, tip, PURPLE)


def _draw_direction(canvas: Canvas, lines: Lines, level_view: LevelView) -> None:
    """Two arrows along the dominant directions, from the point straight above the camera, with their angle."""
    centre = _principal_point(level_view)
    for axis in (0, 1):
        angle = lines.psi_rad + 0.5 * np.pi * axis
        tip = centre + _DIRECTION_PX * np.array([np.cos(angle), np.sin(angle)])
        raw = level_view.to_raw(tilted(np.stack([centre, tip]), lines.tilt_rad, level_view))
        if np.all(np.isfinite(raw)):
            canvas.arrow(raw[0], raw[1], _AXIS_COLOURS[axis], 3)
    psi, roll, pitch = (round(float(np.degrees(v)), 2) + 0.0 for v in (lines.psi_rad, *lines.tilt_rad))
    canvas.text(6, 16, f"direction {psi:.2f} deg, tilt {roll:.2f} {pitch:.2f} deg, {len(lines.axis)} lines")


def draw_particles_panel(
    poses: Array,
    weights: Array | None,
    landmarks_xy_m: Array,
    landmarks_cov_m2: Array | None,
    pose: Array,
    path_xy_m: Array | None = None,
    truth: Array | None = None,
    bounds_m: tuple[float, float, float, float] | None = None,
    size_px: int = 480,
) -> Image:
    """Particles, landmarks with their 2-sigma ellipses, the estimate and its path, from above: x right, y up.

    Args:
        poses: (N, 3) particles; weights (N,) darkens the light ones.
        landmarks_xy_m, landmarks_cov_m2: (L, 2) and (L, 2, 2).
        bounds_m: x_min, y_min, x_max, y_max shown; None = all there is.

    Returns:
        (size_px, size_px, 3) BGR.
    """
    canvas = Canvas(np.full((size_px, size_px, 3), DARK, np.uint8))
    view = PanelView(bounds_m or _bounds(pose, poses, landmarks_xy_m, path_xy_m), size_px)
    _draw_grid(canvas, view)
    if path_xy_m is not None and len(path_xy_m) > 1:
        canvas.curve(view.pixels(path_xy_m), BLUE, 2)
    for k, uv in enumerate(view.pixels(landmarks_xy_m)):
        canvas.disc(uv, _LANDMARK_PX, GREEN)
        if landmarks_cov_m2 is not None:
            canvas.curve(view.pixels(_ellipse(landmarks_xy_m[k], landmarks_cov_m2[k])), GREEN)
    _draw_particles(canvas, view, poses, weights)
    if truth is not None:
        canvas.disc(view.pixels(truth[None, :2])[0], _TRUTH_PX, WHITE, 1)
    _draw_robot(canvas, view, pose)
    return canvas.image


class PanelView:
    """Square top-down view; pixels() takes (N, 2) metres to (N, 2) pixels."""

    def __init__(self, bounds_m: tuple[float, float, float, float], size_px: int) -> None:
        x0, y0, x1, y1 = bounds_m
        self.centre_m = np.array([0.5 * (x0 + x1), 0.5 * (y0 + y1)])
        self.span_m = max(x1 - x0, y1 - y0, 1e-3)
        self.px_per_m = size_px / self.span_m
        self._size_px = size_px

    def pixels(self, xy_m: Array) -> Array:
        off = (np.asarray(xy_m, np.float64).reshape(-1, 2) - self.centre_m) * self.px_per_m
        return np.column_stack([off[:, 0], -off[:, 1]]) + 0.5 * (self._size_px - 1)


def _bounds(pose: Array, poses: Array, landmarks: Array, path: Array | None) -> tuple[float, float, float, float]:
    points = np.vstack([pose[None, :2], poses[:, :2], landmarks.reshape(-1, 2), *([] if path is None else [path])])
    points = points[np.all(np.isfinite(points), axis=1)]
    if not len(points):
        return -1.0, -1.0, 1.0, 1.0
    low, high = np.floor(points.min(axis=0) - _PANEL_MARGIN_M), np.ceil(points.max(axis=0) + _PANEL_MARGIN_M)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def _draw_grid(canvas: Canvas, view: PanelView) -> None:
    """A line a metre (fewer in large rooms), and what it stands for."""
    step_m = float(10 ** np.ceil(np.log10(max(view.span_m / _MOST_GRID_LINES, _FINEST_GRID_M))))
    half = 0.5 * view.span_m
    for k in (0, 1):
        first = np.ceil((view.centre_m[k] - half) / step_m) * step_m
        for value in np.arange(first, view.centre_m[k] + half + 1e-9, step_m):
            ends = np.stack([view.centre_m - half, view.centre_m + half])
            ends[:, k] = value
            canvas.curve(view.pixels(ends), _GRID)
    canvas.text(6, canvas.image.shape[0] - 8, f"grid {step_m:g} m", GREY)


def _draw_particles(canvas: Canvas, view: PanelView, poses: Array, weights: Array | None) -> None:
    strength = np.ones(len(poses)) if weights is None else np.nan_to_num(weights)
    strength = strength / max(float(np.max(strength, initial=0.0)), 1e-300)
    uv = view.pixels(poses[:, :2])
    heading = np.column_stack([np.cos(poses[:, 2]), -np.sin(poses[:, 2])])
    for k in np.argsort(strength, kind="stable"):
        strong = _FAINTEST + (1.0 - _FAINTEST) * float(strength[k])
        b, g, r = (round(strong * o + (1.0 - strong) * d) for o, d in zip(ORANGE, DARK, strict=True))
        canvas.curve(np.stack([uv[k], uv[k] + _HEADING_PX * heading[k]]), (b, g, r))
        canvas.disc(uv[k], _PARTICLE_PX, (b, g, r))


def _draw_robot(canvas: Canvas, view: PanelView, pose: Array) -> None:
    if not np.all(np.isfinite(pose)):
        return
    centre = view.pixels(pose[None, :2])[0]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    turned = centre + _ROBOT_PX @ np.array([[c, -s], [s, c]]).T * [1.0, -1.0]
    canvas.curve(turned, WHITE, 1)


def _ellipse(centre_m: Array, cov_m2: Array) -> Array:
    """(K, 2) points of the 2-sigma ellipse."""
    values, vectors = np.linalg.eigh(cov_m2)
    angle = np.linspace(0.0, 2.0 * np.pi, _ELLIPSE_POINTS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(centre_m + _ELLIPSE_SIGMAS * circle * np.sqrt(np.maximum(values, 0.0)) @ vectors.T, np.float64)


def side_by_side(left: Image, right: Image, captions: Mapping[str, str] | None = None) -> Image:
    """Two pictures of one height, the right one resized to the left's; captions by "left" and "right"."""
    height = left.shape[0]
    width = round(right.shape[1] * height / right.shape[0])
    resized = cv2.resize(right, (width, height), interpolation=cv2.INTER_AREA) if height != right.shape[0] else right
    image = np.asarray(np.hstack([left, resized]), np.uint8)
    canvas = Canvas(image)
    for name, x in (("left", 6), ("right", left.shape[1] + 6)):
        if captions and name in captions:
            canvas.text(x, height - 8 if name == "left" else 16, captions[name])
    return image
