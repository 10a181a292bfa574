"""Plots for the record, of the kind that Kalibr and mrcal draw, without any library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.record.drawing import GREY, PALE, SERIES, Chart, Drawing, equal, scale_bar, shades
from ceilvo.calib.solve.intrinsics import Intrinsics, Shot
from ceilvo.camera import CameraModel

Array = NDArray[np.float64]
_W, _H = 640.0, 400.0
_BOX = (70.0, 28.0, 520.0, 350.0)
_VECTOR_SHARE = 0.05
"""Of the picture's width: how long the vector of a residual of three times the rms is drawn; chosen to be seen."""
_GRID = (32, 24)
"""Cells of the picture in which uncertainty is drawn."""


def radial(rings: Sequence[Mapping[str, float]]) -> str:
    """Residuals of the lens model against the distance from the principal point."""
    r = np.array([g["r_px"] for g in rings])
    series = {
        name: np.array([g[key] for g in rings]) for name, key in (("rms", "rms_px"), ("along radius", "along_px"))
    }
    most = 1.1 * max(1e-6, max(float(np.abs(v).max()) for v in series.values()))
    chart = Chart(
        Drawing(_W, _H),
        _BOX,
        (0.0, 1.05 * float(r.max())),
        (min(0.0, -most if series["along radius"].min() < 0 else 0.0), most),
    )
    chart.axes("distance from the principal point [px]", "residual [px]")
    for (_, values), colour in zip(series.items(), SERIES, strict=False):
        points = chart.at(np.column_stack([r, values]))
        chart.drawing.line(points, colour)
        chart.drawing.dots(points, colour)
    chart.legend(zip(series, SERIES, strict=False))
    return chart.drawing.svg()


def reprojection(fit: Intrinsics) -> str:
    """Residuals of all corners, coloured by view, with the circle of their rms."""
    view = _views(fit)
    most = 1.1 * max(1e-6, float(np.abs(fit.residual_px).max()))
    wide = (_BOX[2] - _BOX[0]) / (_BOX[3] - _BOX[1])
    chart = Chart(Drawing(_W, _H), _BOX, (-most * wide, most * wide), (-most, most))
    chart.axes("residual in u [px]", "residual in v [px]")
    chart.drawing.dots(chart.at(fit.residual_px), shades(view, 0, max(len(fit.shots) - 1, 1)), 1.8)
    centre, edge = chart.at([(0.0, 0.0), (fit.rms_px * np.sqrt(2.0), 0.0)])
    chart.drawing.ring((float(centre[0]), float(centre[1])), float(edge[0] - centre[0]), "#d55e00")
    scale_bar(chart.drawing, (560.0, 60.0, 576.0, 320.0), 1, len(fit.shots), "view")
    return chart.drawing.svg()


def vectors(fit: Intrinsics) -> str:
    """Residuals over the picture as lines from each corner, enlarged, coloured by view."""
    chart = _picture(fit.camera)
    factor = _VECTOR_SHARE * fit.camera.width_px / max(3.0 * fit.rms_px, 1e-9)
    factor = float(f"{factor:.1g}")
    chart.axes("u [px]", "v [px]", f"residuals drawn {factor:g} times as long")
    colours = shades(_views(fit), 0, max(len(fit.shots) - 1, 1))
    starts = chart.at(fit.uv_px)
    chart.drawing.segments(starts, chart.at(fit.uv_px + factor * fit.residual_px), colours)
    chart.drawing.dots(starts, colours, 1.2)
    scale_bar(chart.drawing, (590.0, 60.0, 604.0, 320.0), 1, len(fit.shots), "view")
    return chart.drawing.svg()


def poses(fit: Intrinsics) -> str:
    """Where the board was held, from the side and from above the camera, which looks to the right."""
    outlines = [_outline(shot, pose) for shot, pose in zip(fit.shots, fit.poses, strict=True)]
    drawing = Drawing(2 * _W - 220.0, _H)
    for k, row in enumerate((1, 0)):
        flat = [np.column_stack([o[:, 2], -o[:, row]]) for o in outlines]
        box = (70.0 + 530.0 * k, 28.0, 520.0 + 530.0 * k, 350.0)
        x, y = equal(np.concatenate([*flat, np.zeros((1, 2))]), box[2] - box[0], box[3] - box[1])
        chart = Chart(drawing, box, x, y)
        chart.axes(
            "z, away from the camera [m]",
            "height [m]" if row else "to the left [m]",
            "from the side" if row else "from above",
        )
        for points, colour in zip(flat, shades(np.arange(len(flat)), 0, max(len(flat) - 1, 1)), strict=True):
            drawing.line(chart.at(points), colour, 1.2)
        drawing.dots(chart.at((0.0, 0.0)), "#d55e00", 5)
    return drawing.svg()


def uncertainty(fit: Intrinsics) -> str:
    """The sigma of the lens over the picture (see uncertainty_px)."""
    sigma, chart = uncertainty_px(fit.camera, fit.cov, _GRID), _picture(fit.camera)
    known = sigma[np.isfinite(sigma)]
    low, high = float(known.min()), float(np.quantile(known, 0.98))
    columns, rows = _GRID
    corners = chart.at([(0.0, 0.0), (fit.camera.width_px / columns, fit.camera.height_px / rows)])
    (left, top), (w, h) = corners[0].tolist(), (corners[1] - corners[0]).tolist()
    colours = shades(np.nan_to_num(sigma.ravel(), nan=high), low, high)
    for k, colour in enumerate(colours):
        j, i = divmod(k, columns)
        chart.drawing.rect(left + i * w, top + j * h, w + 0.4, h + 0.4, colour if np.isfinite(sigma[j, i]) else PALE)
    chart.axes("u [px]", "v [px]", "sigma of where a ray falls, by the lens alone [px]")
    scale_bar(chart.drawing, (590.0, 60.0, 604.0, 320.0), low, high, "sigma [px]")
    return chart.drawing.svg()


def uncertainty_px(camera: CameraModel, cov: Array, grid: tuple[int, int]) -> Array:
    """(rows, columns) px, the larger axis of the covariance of where a ray of a cell's middle falls, nan where the lens
    sees nothing. What a turn of the camera would undo is taken out: mounting and projection find that.

    Args:
        cov: of fx, fy, cx, cy and the distortion.
        grid: columns, rows.
    """
    columns, rows = grid
    u, v = np.meshgrid(
        (np.arange(columns) + 0.5) / columns * camera.width_px, (np.arange(rows) + 0.5) / rows * camera.height_px
    )
    rays = camera.rays(np.column_stack([u.ravel(), v.ravel()]))
    spread = np.sqrt(np.diag(cov))
    names = ("fx_px", "fy_px", "cx_px", "cy_px")
    moved = []
    for k, step in enumerate(np.maximum(spread, 1e-12)):
        if k < len(names):
            other = replace(camera, **{names[k]: getattr(camera, names[k]) + step})
        else:
            d = list(camera.distortion)
            d[k - len(names)] += float(step)
            other = replace(camera, distortion=tuple(d))
        moved.append((other.pixels(rays) - camera.pixels(rays)) / step)
    turns = [(camera.pixels(rays + 1e-5 * np.cross(axis, rays)) - camera.pixels(rays)) / 1e-5 for axis in np.eye(3)]
    jacobian = np.stack(moved, axis=-1)  # (cells, 2, parameters)
    by_turn = np.stack(turns, axis=-1)
    good = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(by_turn).all(axis=(1, 2))
    a, b = by_turn[good].reshape(-1, 3), jacobian[good].reshape(-1, jacobian.shape[2])
    left = (b - a @ np.linalg.lstsq(a, b, rcond=None)[0]).reshape(-1, 2, b.shape[1])
    out = np.full(len(rays), np.nan)
    out[good] = np.sqrt(np.maximum(np.linalg.eigvalsh(left @ cov @ np.swapaxes(left, 1, 2))[:, -1], 0.0))
    return out.reshape(rows, columns)


def sigma(curves: Mapping[str, Mapping[str, Any]]) -> str:
    """sigma(r) with its band and what was measured."""
    most_r = 1.05 * max(float(np.max(c["r_m"])) for c in curves.values())
    most = 1.1e3 * max(max(float(np.max(c["high_m"])), *map(float, c["circle_sigma_m"])) for c in curves.values())
    chart = Chart(Drawing(_W, _H), _BOX, (0.0, most_r), (0.0, most))
    chart.axes("r, distance from the point below the camera [m]", "sigma [mm]")
    for c, colour in zip(curves.values(), SERIES, strict=False):
        r = np.asarray(c["r_m"], np.float64)
        fitted = np.polynomial.polynomial.polyval(r, c["coefficients"])
        for values, dash in ((c["low_m"], "4 3"), (c["high_m"], "4 3"), (fitted, "")):
            chart.drawing.line(
                chart.at(np.column_stack([r, 1e3 * np.asarray(values)])), colour, 1.0 if dash else 2.0, dash=dash
            )
        chart.drawing.dots(
            chart.at(np.column_stack([c["circle_r_m"], 1e3 * np.asarray(c["circle_sigma_m"])])), colour, 3.5
        )
    chart.legend((f"sigma_{name}, its 95 % band", colour) for name, colour in zip(curves, SERIES, strict=False))
    return chart.drawing.svg()


def scatter(samples: Mapping[str, Sequence[float]]) -> str:
    """Observed positions about the true one, as the paper's fig. 2, coloured by distance."""
    xy = 1e3 * np.column_stack([samples["dx_m"], samples["dy_m"]])
    x, y = equal(np.concatenate([xy, -xy]), _BOX[2] - _BOX[0], _BOX[3] - _BOX[1])
    chart = Chart(Drawing(_W, _H), _BOX, x, y)
    chart.axes("error in x [mm]", "error in y [mm]")
    r = np.asarray(samples["r_m"], np.float64)
    chart.drawing.dots(chart.at(xy), shades(r, 0.0, float(r.max())))
    chart.drawing.dots(chart.at((0.0, 0.0)), "#d55e00", 5)
    scale_bar(chart.drawing, (560.0, 60.0, 576.0, 320.0), 0.0, float(r.max()), "r [m]")
    return chart.drawing.svg()


def paths(spin_xy_m: Sequence[Sequence[float]], run_xy_m: Sequence[Sequence[float]]) -> str:
    """The camera's circle in the spin and the base's run."""
    drawing = Drawing(2 * _W - 220.0, _H)
    for k, (xy, title) in enumerate(((spin_xy_m, "camera in the spin"), (run_xy_m, "base in the run"))):
        box = (70.0 + 530.0 * k, 28.0, 520.0 + 530.0 * k, 350.0)
        chart = Chart(drawing, box, *equal(xy, box[2] - box[0], box[3] - box[1]))
        chart.axes("x [m]", "y [m]", title)
        points = chart.at(xy)
        drawing.line(points, GREY, 1.0)
        drawing.dots(points, SERIES[0])
    return drawing.svg()


def _views(fit: Intrinsics) -> Array:
    """The number of its view, for each corner."""
    return np.repeat(np.arange(len(fit.shots), dtype=np.float64), [len(s.uv_px) for s in fit.shots])


def _picture(camera: CameraModel) -> Chart:
    """A chart of the camera's picture, as large as there is room."""
    w, h = float(camera.width_px), float(camera.height_px)
    scale = min(460.0 / w, 322.0 / h)
    return Chart(Drawing(_W, _H), (70.0, 28.0, 70.0 + scale * w, 28.0 + scale * h), (0.0, w), (0.0, h), down=True)


def _outline(shot: Shot, pose: Array) -> Array:
    """(5, 3) m, the rim of a board's seen corners in the camera's frame; pose: rotation vector, translation."""
    x, y = shot.xyz_m[:, 0], shot.xyz_m[:, 1]
    rim = np.array([(x.min(), y.min()), (x.max(), y.min()), (x.max(), y.max()), (x.min(), y.max()), (x.min(), y.min())])
    angle = float(np.linalg.norm(pose[:3]))
    axis = pose[:3] / max(angle, 1e-12)
    points = np.column_stack([rim, np.zeros(len(rim))])
    turned = (
        points * np.cos(angle)
        + np.cross(axis, points) * np.sin(angle)
        + np.outer(points @ axis, axis) * (1 - np.cos(angle))
    )
    return np.asarray(turned + pose[3:6])
