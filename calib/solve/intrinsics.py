"""Lens and sensor from corners of a board: pinhole, rational and fisheye models, with sigma, chosen by evidence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.lens import camera_of
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

MODELS = ("pinhole", "pinhole8", "fisheye")
"""Lens models: pinhole with 5 or 8 coefficients of distortion, fisheye with 4."""
_COUNT = {"pinhole": 5, "pinhole8": 8, "fisheye": 4}
NAMES = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3"),
    "pinhole8": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
MIN_SHOTS = 6
_FOLDS = 4
_BETTER = 0.03
_OUTLIER = 3.0
_MOST_DROPPED = 0.3


@dataclass(frozen=True)
class Shot:
    """One picture's corners: name for messages, board points (N, 3) m, uv_px (N, 2) raw pixels."""

    name: str
    xyz_m: Array
    uv_px: Array


@dataclass(frozen=True)
class Intrinsics:
    """A lens with what is known about how good it is.

    Attributes:
        model: of MODELS.
        sigma: (4 + coefficients,) of fx, fy, cx, cy and the distortion.
        cov: the same, whole.
        rms_px: over both coordinates of a corner, as OpenCV reports it.
        shots: that count; dropped: (name, reason).
        shot_rms_px: of each shot that counts.
        residual_px: (N, 2) of every corner, and uv_px (N, 2) where it is, for plots.
        poses: (shots, 6) camera_from_board as rotation vector and translation.
    """

    camera: CameraModel
    model: str
    sigma: Array
    cov: Array
    rms_px: float
    shots: tuple[Shot, ...]
    dropped: tuple[tuple[str, str], ...]
    shot_rms_px: Array
    residual_px: Array
    uv_px: Array
    poses: Array


def calibrate(shots: list[Shot], size: tuple[int, int], model: str, *, keep_all: bool = False) -> Intrinsics:
    """Fit one model; shots far worse than the rest are dropped, with reason, unless all are to be kept.

    Args:
        size: width, height px.

    Raises:
        CalibrationError: too few shots, or no start that leads anywhere.
    """
    if len(shots) < MIN_SHOTS:
        raise CalibrationError(f"intrinsics: found {len(shots)} usable pictures, expected at least {MIN_SHOTS}")
    kept, dropped = list(shots), list[tuple[str, str]]()
    while True:
        fit = _fit(kept, size, model)
        rms = _rms_each(fit)
        limit = _OUTLIER * float(np.median(rms))
        worst = int(np.argmax(rms))
        room = len(dropped) < _MOST_DROPPED * len(shots) and len(kept) > MIN_SHOTS
        if keep_all or rms[worst] <= limit or not room:
            break
        dropped.append((kept[worst].name, f"residual {rms[worst]:.2f} px, the others have {np.median(rms):.2f} px"))
        del kept[worst]
    residuals = np.concatenate(fit.residuals).reshape(-1, 2)
    return Intrinsics(
        camera=camera_of(model, fit.shared, size),
        model=model,
        sigma=np.sqrt(np.diag(fit.cov)),
        cov=fit.cov,
        rms_px=float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
        shots=tuple(kept),
        dropped=tuple(dropped),
        shot_rms_px=rms,
        residual_px=residuals,
        uv_px=np.concatenate([s.uv_px for s in kept]),
        poses=fit.views,
    )


def choose_model(
    shots: list[Shot], size: tuple[int, int], models: tuple[str, ...] = MODELS
) -> tuple[str, dict[str, float]]:
    """The simplest model that predicts shots left out of the fit nearly as well as any, and rms_px of each.

    Raises:
        CalibrationError: no model fits.
    """
    scores: dict[str, float] = {}
    for model in models:
        try:
            scores[model] = _held_out_rms(shots, size, model)
        except (CalibrationError, np.linalg.LinAlgError):
            scores[model] = np.inf
    best = min(scores.values())
    if not np.isfinite(best):
        raise CalibrationError("intrinsics: no lens model fits these pictures; is the board flat, is its size right?")
    return next(m for m in models if scores[m] <= best * (1.0 + _BETTER)), scores


def _held_out_rms(shots: list[Shot], size: tuple[int, int], model: str) -> float:
    """Each fold's corners against the lens of the other folds; only the board's pose is fitted to them."""
    total, count = 0.0, 0
    folds = min(_FOLDS, len(shots) // 3)
    if folds < 2:
        raise CalibrationError(f"intrinsics: found {len(shots)} usable pictures, expected at least {MIN_SHOTS}")
    start = _fit(shots, size, model, rounds=25)
    for k in range(folds):
        rest = [s for i, s in enumerate(shots) if i % folds != k]
        poses = np.array([p for i, p in enumerate(start.views) if i % folds != k])
        camera = camera_of(model, _solve(rest, size, model, start.shared, poses, rounds=15).shared, size)
        for i, shot in enumerate(shots):
            if i % folds == k:
                r = _pose_residual(camera, shot, start.views[i])
                total, count = total + float(r @ r), count + len(r) // 2
    return float(np.sqrt(total / count))


def _pose_residual(camera: CameraModel, shot: Shot, pose: Array) -> Array:
    fit = bundle.solve(lambda _, __, p: _reproject(camera, shot, p), np.zeros(0), pose[None], rounds=15)
    return fit.residuals[0]


def _fit(shots: list[Shot], size: tuple[int, int], model: str, rounds: int = 60) -> bundle.BundleFit:
    """From several focal lengths the best start, then all."""
    best: bundle.BundleFit | None = None
    for focal_per_width in (0.6, 0.85, 1.2, 0.35):
        try:
            fit = _solve(shots, size, model, *_start(shots, size, model, focal_per_width * size[0]), rounds=8)
        except (cv2.error, CalibrationError, np.linalg.LinAlgError):
            continue
        if np.isfinite(fit.rms) and (best is None or fit.rms < best.rms):
            best = fit
        if best is not None and best.rms < 1.0:
            break
    if best is None:
        raise CalibrationError("intrinsics: found no lens that explains the corners; is it the right board?")
    return _solve(shots, size, model, best.shared, best.views, rounds=rounds)


def _start(shots: list[Shot], size: tuple[int, int], model: str, f: float) -> tuple[Array, Array]:
    p = np.array([f, f, 0.5 * (size[0] - 1), 0.5 * (size[1] - 1), *np.zeros(_COUNT[model])])
    camera = camera_of(model, p, size)
    return p, np.array([board_pose(camera, s) for s in shots])


def board_pose(camera: CameraModel, shot: Shot) -> Array:
    """(6,) rotation vector and translation, camera_from_board, by OpenCV's IPPE on rays."""
    rays = camera.rays(shot.uv_px)
    front = rays[:, 2] > 0.1
    if np.count_nonzero(front) < 4:
        raise CalibrationError(f"{shot.name}: fewer than 4 corners in front of the camera")
    xy = rays[front, :2] / rays[front, 2:]
    ok, rvec, tvec = cv2.solvePnP(shot.xyz_m[front], xy, np.eye(3), np.zeros(5), flags=cv2.SOLVEPNP_IPPE)
    if not ok:
        raise CalibrationError(f"{shot.name}: no pose of the board")
    return np.concatenate([np.ravel(rvec), np.ravel(tvec)])


def _solve(
    shots: list[Shot], size: tuple[int, int], model: str, p: Array, poses: Array, rounds: int
) -> bundle.BundleFit:
    def residuals(i: int, shared: Array, pose: Array) -> Array:
        return _reproject(camera_of(model, shared, size), shots[i], pose)

    return bundle.solve(residuals, p, poses, rounds=rounds)


def _reproject(camera: CameraModel, shot: Shot, pose: Array) -> Array:
    points = shot.xyz_m @ cv2.Rodrigues(pose[:3])[0].T + pose[3:]
    off = camera.pixels(points) - shot.uv_px
    return np.asarray(np.nan_to_num(off, nan=1e3).ravel())


def _rms_each(fit: bundle.BundleFit) -> Array:
    return np.array([np.sqrt(2.0 * np.mean(r**2)) for r in fit.residuals])


# -- coverage


@dataclass(frozen=True)
class Coverage:
    """How well the shots cover what must be covered.

    Attributes:
        cells: (6, 8) corners in each part of the picture.
        area: fraction of the parts with a corner in them.
        reach: farthest corner from the middle over half the diagonal.
        tilted: shots in which the board leans by 15 deg or more.
        distance_ratio: farthest over nearest board.
    """

    cells: NDArray[np.int64]
    area: float
    reach: float
    tilted: int
    distance_ratio: float

    GATE_AREA = 0.70
    GATE_REACH = 0.70
    GATE_TILTED = 3
    GATE_RATIO = 1.2

    def missing(self) -> list[str]:
        """What to do next; empty when the gate is passed."""
        out = []
        if self.area < self.GATE_AREA or self.reach < self.GATE_REACH:
            out.append(f"hold the board where the picture is empty: {self.empty_places()}")
        if self.tilted < self.GATE_TILTED:
            out.append(f"lean the board by 20 to 45 deg: {self.tilted} such pictures, {self.GATE_TILTED} needed")
        if self.distance_ratio < self.GATE_RATIO:
            out.append(
                f"vary the distance: farthest over nearest is {self.distance_ratio:.2f}, {self.GATE_RATIO} needed"
            )
        return out

    def empty_places(self) -> str:
        rows, columns = ("top", "middle", "bottom"), ("left", "centre", "right")
        empty = []
        for i, row in enumerate(np.array_split(self.cells, 3, axis=0)):
            for j, part in enumerate(np.array_split(row, 3, axis=1)):
                if np.mean(part > 0) < self.GATE_AREA:
                    empty.append(f"{rows[i]} {columns[j]}")
        return ", ".join(empty) or "the corners"

    @property
    def text(self) -> str:
        return (
            f"area {100 * self.area:.0f} %, reach {100 * self.reach:.0f} %, leaning {self.tilted}, "
            f"distance 1:{self.distance_ratio:.2f}"
        )


def coverage(shots: list[Shot], size: tuple[int, int]) -> Coverage:
    cells = np.zeros((6, 8), np.int64)
    reach, tilts, distances = 0.0, [], []
    guess = camera_of("pinhole", np.array([0.8 * size[0], 0.8 * size[0], size[0] / 2, size[1] / 2, *np.zeros(5)]), size)
    for shot in shots:
        u = np.clip((shot.uv_px / np.array(size) * [8, 6]).astype(int), 0, [7, 5])
        np.add.at(cells, (u[:, 1], u[:, 0]), 1)
        off = np.hypot(*(shot.uv_px - 0.5 * np.array(size)).T)
        reach = max(reach, float(off.max()) / float(np.hypot(*size) / 2))
        pose = board_pose(guess, shot)
        tilts.append(np.degrees(np.arccos(min(1.0, abs(float(cv2.Rodrigues(pose[:3])[0][2, 2]))))))
        distances.append(float(np.linalg.norm(pose[3:])))
    ratio = max(distances) / min(distances) if distances else 1.0
    return Coverage(cells, float(np.mean(cells > 0)), reach, int(np.sum(np.array(tilts) >= 15.0)), ratio)


def coverage_picture(
    shots: list[Shot], size: tuple[int, int], gray: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """(H, W, 3) the picture with every corner so far, empty parts shaded."""
    w, h = size
    image = np.full((h, w, 3), 60, np.uint8) if gray is None else cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR) // 2
    image = np.ascontiguousarray(image)
    for (j, i), n in np.ndenumerate(coverage(shots, size).cells):
        if n == 0:
            a, b = (int(i * w / 8), int(j * h / 6)), (int((i + 1) * w / 8), int((j + 1) * h / 6))
            image[a[1] : b[1], a[0] : b[0], 2] = np.minimum(image[a[1] : b[1], a[0] : b[0], 2] + 70, 255)
    for shot in shots:
        for u, v in shot.uv_px:
            cv2.circle(image, (round(float(u)), round(float(v))), max(2, w // 320), (80, 220, 80), -1)
    return np.asarray(image, np.uint8)


def problems(fit: Intrinsics, covered: Coverage, limit_px: float = 0.5) -> list[str]:
    """What keeps the result from a PASS, with what to do."""
    out = list(covered.missing())
    if fit.rms_px > limit_px:
        out.append(
            f"rms is {fit.rms_px:.2f} px, at most {limit_px:g} expected: flat board? right size? sharp pictures?"
        )
    f_sigma = max(fit.sigma[0] / fit.camera.fx_px, fit.sigma[1] / fit.camera.fy_px)
    if f_sigma > 0.003:
        out.append(f"the focal length is known to {100 * f_sigma:.2f} % only, 0.3 needed: more pictures, leaning")
    if max(fit.sigma[2:4]) > 2.0:
        out.append(f"the principal point is known to {max(fit.sigma[2:4]):.1f} px only, 2 needed: more pictures")
    if not _monotone(fit.camera):
        out.append(
            "the distortion folds the picture's corners over: pictures with the board in the corners are missing"
        )
    return out


def _monotone(camera: CameraModel) -> bool:
    """Whether farther from the axis is farther in the picture, as far as the picture goes."""
    w, h = camera.width_px, camera.height_px
    corners = np.array([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1.0]])
    back = camera.pixels(camera.rays(corners))
    return bool(np.all(np.hypot(*(back - corners).T) < 0.5))


def fit_best(
    shots: list[Shot], size: tuple[int, int], model: str = "auto", *, keep_all: bool = False
) -> tuple[Intrinsics, dict[str, float]]:
    """The chosen model's fit and the held-out rms of each model tried (none when the model was given)."""
    if model != "auto":
        return calibrate(shots, size, model, keep_all=keep_all), {}
    first = calibrate(shots, size, "pinhole", keep_all=keep_all)  # outliers are none of the models' business
    usable = list(first.shots) if first.rms_px < 3.0 else shots
    chosen, scores = choose_model(usable, size)
    fit = calibrate(usable, size, chosen, keep_all=keep_all)
    gone = {name for name, _ in fit.dropped} | {s.name for s in fit.shots}
    return replace(fit, dropped=fit.dropped + tuple(d for d in first.dropped if d[0] not in gone)), scores
