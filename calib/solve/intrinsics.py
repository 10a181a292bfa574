"""Lens and sensor from corners of a board: pinhole, rational and fisheye models, with sigma, chosen by evidence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.solve import bundle
from ceilvo.calib.solve.lens import camera_of, reprojection
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError

Array = NDArray[np.float64]

MODELS = ("pinhole", "pinhole8", "fisheye")
"""Lens models: pinhole with 5 or 8 coefficients of distortion, fisheye with 4."""
_COUNT = {"pinhole": 5, "pinhole8": 8, "fisheye": 4}
"""Coefficients of distortion."""
NAMES = {
    "pinhole": ("k1", "k2", "p1", "p2", "k3"),
    "pinhole8": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
MIN_SHOTS = 6
"""Six poses and the lens leave a chessboard's corners redundant; fewer leave too little for folds."""
_FOLDS = 4
"""Of the choice of the model; chosen."""
_BETTER = 0.03
"""A model with more coefficients must predict shots left out better by more than 3 % (docs/calibration.md)."""
_SIMPLEST = ("pinhole", "fisheye", "pinhole8")
"""By the number of lenses that have it, and of coefficients: eight follow a fisheye nearly as well as its own four."""
_CHANCE, _NEVER_WORSE = 2.0, 1.5
"""Standard errors of the mean difference between two models that chance may make, and rms that no chance excuses."""
_OUTLIER = 3.0
"""Times the shots' median rms beyond which a shot is dropped (docs/calibration.md)."""
_MOST_DROPPED = 0.3
"""Fraction of the shots; where more do not fit, the model or the board is wrong."""
_MIN_PER_FOLD = 3
"""Shots; smaller folds only cost time, but fewer shots are left out one by one: half of six do not make a lens."""
_FOCALS = (0.6, 0.85, 1.2, 0.35)
"""Focal lengths over the picture's width to start from, the likely ones first: 80, 61, 45 and 110 deg across."""
_ROUNDS_TRY, _ROUNDS_START, _ROUNDS_FOLD = 8, 25, 15
"""Least squares' steps at the most: to compare starts, to prepare the folds, and for a fold, which starts near."""
_GOOD_START_PX = 1.0
"""rms after few steps at which no other start is tried."""
_FRONT = 0.1
"""Cosine to the axis from which a ray can be projected to a plane to find a first pose."""
RMS_PX, _FOCAL_SIGMA, _CENTRE_SIGMA_PX = 0.5, 0.003, 2.0
"""Gates of a PASS; OpenCV's own chessboard pictures have 0.18 px (docs/calibration.md), simulated rigs
0.1 px of 410."""
_SANE_PX = 3.0
"""rms up to which the pinhole fit's outliers are outliers, and not what the model lacks."""
_FOLDED_PX = 0.5
"""A corner of the picture that comes back elsewhere from its ray: the distortion folds over."""


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
    # Corners of a picture err together: the board bends, the focus is off, light bleeds. Too few pictures tell how the
    # parameters err together, so that is as if corners erred alone.
    cov = bundle.at_least(fit.cov, fit.cluster_cov)
    return Intrinsics(
        camera=camera_of(model, fit.shared, size),
        model=model,
        sigma=np.sqrt(np.diag(cov)),
        cov=cov,
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
    """The first model of _SIMPLEST that predicts shots left out of the fit as well as any, and rms_px of each.

    As well: within a few percent, or no worse than the shots themselves scatter about the difference, which with few
    shots is much.

    Raises:
        CalibrationError: no model fits.
    """
    squares: dict[str, Array] = {}
    for model in models:
        try:
            squares[model] = _held_out(shots, size, model)
        except (CalibrationError, np.linalg.LinAlgError):
            squares[model] = np.full(len(shots), np.inf)
    corners = np.array([len(s.uv_px) for s in shots], np.float64)
    scores = {m: float(np.sqrt(q.sum() / corners.sum())) for m, q in squares.items()}
    best = min(scores, key=lambda m: scores[m])
    if not np.isfinite(scores[best]):
        raise CalibrationError("intrinsics: no lens model fits these pictures; is the board flat, is its size right?")
    for model in (m for m in _SIMPLEST if m in models):
        if scores[model] <= scores[best] * (1.0 + _BETTER):
            return model, scores
        if np.isfinite(scores[model]) and scores[model] <= scores[best] * _NEVER_WORSE:
            worse = (squares[model] - squares[best]) / corners
            if worse.mean() <= _CHANCE * worse.std(ddof=1) / np.sqrt(len(worse)):
                return model, scores
    return best, scores


def _held_out(shots: list[Shot], size: tuple[int, int], model: str) -> Array:
    """(shots,) sum of squares of each one's corners against the lens of the other folds; only its pose is fitted."""
    out = np.zeros(len(shots))
    folds = _FOLDS if len(shots) >= _FOLDS * _MIN_PER_FOLD else len(shots)
    if len(shots) < MIN_SHOTS:
        raise CalibrationError(f"intrinsics: found {len(shots)} usable pictures, expected at least {MIN_SHOTS}")
    start = _fit(shots, size, model, rounds=_ROUNDS_START)
    for k in range(folds):
        rest = [s for i, s in enumerate(shots) if i % folds != k]
        poses = np.array([p for i, p in enumerate(start.views) if i % folds != k])
        camera = camera_of(model, _solve(rest, size, model, start.shared, poses, rounds=_ROUNDS_FOLD).shared, size)
        for i, shot in enumerate(shots):
            if i % folds == k:
                r = _pose_residual(camera, shot, start.views[i])
                out[i] = float(r @ r)
    return out


def _pose_residual(camera: CameraModel, shot: Shot, pose: Array) -> Array:
    fit = bundle.solve(lambda _, __, p: _reproject(camera, shot, p), np.zeros(0), pose[None], rounds=_ROUNDS_FOLD)
    return fit.residuals[0]


def _fit(shots: list[Shot], size: tuple[int, int], model: str, rounds: int = 60) -> bundle.BundleFit:
    """From several focal lengths the best start, then all."""
    best: bundle.BundleFit | None = None
    for focal_per_width in _FOCALS:
        try:
            fit = _solve(shots, size, model, *_start(shots, size, model, focal_per_width * size[0]), rounds=_ROUNDS_TRY)
        except (cv2.error, CalibrationError, np.linalg.LinAlgError):
            continue
        if np.isfinite(fit.rms) and (best is None or fit.rms < best.rms):
            best = fit
        if best is not None and best.rms < _GOOD_START_PX:
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
    front = rays[:, 2] > _FRONT
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
    return reprojection(camera, points, shot.uv_px)


def _rms_each(fit: bundle.BundleFit) -> Array:
    return np.array([np.sqrt(2.0 * np.mean(r**2)) for r in fit.residuals])


def problems(fit: Intrinsics, limit_px: float = RMS_PX) -> list[str]:
    """What keeps the result from a PASS, with what to do."""
    out = []
    if fit.rms_px > limit_px:
        out.append(
            f"rms is {fit.rms_px:.2f} px, at most {limit_px:g} expected: flat board? right size? sharp pictures?"
        )
    f_sigma = max(fit.sigma[0] / fit.camera.fx_px, fit.sigma[1] / fit.camera.fy_px)
    if f_sigma > _FOCAL_SIGMA:
        found, needed = 100 * f_sigma, 100 * _FOCAL_SIGMA
        out.append(f"the focal length is known to {found:.2f} % only, {needed:g} needed: more pictures, leaning")
    centre_px = max(fit.sigma[2:4])
    if centre_px > _CENTRE_SIGMA_PX:
        out.append(
            f"the principal point is known to {centre_px:.1f} px only, {_CENTRE_SIGMA_PX:g} needed: more pictures"
        )
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
    return bool(np.all(np.hypot(*(back - corners).T) < _FOLDED_PX))


def fit_best(
    shots: list[Shot], size: tuple[int, int], model: str = "auto", *, keep_all: bool = False
) -> tuple[Intrinsics, dict[str, float]]:
    """The chosen model's fit and the held-out rms of each model tried (none when the model was given)."""
    if model != "auto":
        return calibrate(shots, size, model, keep_all=keep_all), {}
    first = calibrate(shots, size, "pinhole", keep_all=keep_all)  # outliers are none of the models' business
    usable = list(first.shots) if first.rms_px < _SANE_PX else shots
    chosen, scores = choose_model(usable, size)
    fit = calibrate(usable, size, chosen, keep_all=keep_all)
    gone = {name for name, _ in fit.dropped} | {s.name for s in fit.shots}
    return replace(fit, dropped=fit.dropped + tuple(d for d in first.dropped if d[0] not in gone)), scores
