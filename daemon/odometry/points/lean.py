"""What a robot that rocks under points alone makes of its motion: no line tells its tilt, but points tell that it does.

A tilt moves what is far off the vertical further than what is above, so two views of four points and more show how far
the robot leaned between them. That is not taken off: what a lens is off by looks the same. It is how far the motion may
be wrong. What goes on alike from step to step is the lens's.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo import se2
from ceilvo.daemon.odometry.points.constellation import LEANS, Points
from ceilvo.types import Array

_FEWEST = 4
"""Points that tell motion and lean, with three equations to spare."""
_FRAMES = 45.0
"""That mean and variances are taken over, as for the tilt that lines tell: 1.5 s at 30 Hz; chosen."""
_KNOWN = 40.0
"""Of which so many tell whether it rocks at all; chosen: 1.3 s at 30 Hz."""
_STEP_M, _VIEW_M = 0.005, 0.015
"""What is looked for in a step and in a view: where points tell it with that standard deviation, a frame counts half.
Chosen: 2 deg at 0.4 Hz move a step of 30 Hz by 6 mm, and from 15 mm on it is said."""
_SWAY_S = 2.0
"""Time constant in which a lean is taken to be over: bodies sway at 0.3 Hz and faster; chosen."""
_ALIKE = 4.0
"""Views that err alike while a body sways, which a filter takes to err each on its own; chosen: ten a second, and a
sway of 0.3 to 0.7 Hz."""
_SIGMAS = 4.0
"""Residual by which a point is left out, of its own standard deviation; as in eq. 16."""


@dataclass(slots=True)
class LeanState:
    """In the steps so far, along base x and y.

    Attributes:
        frames: steps that told, each by how well, at most those of the mean; view_frames: the same of views.
        mean_m: (2,) by which a lean would change a step, on average.
        step_m2: (2,) variance of that about the mean, what the points' own error makes taken off.
        sway_m: (2,) the sum of the last seconds; sway_noise_m2: (2,) its variance by the points' own error.
        view_m2: (2,) its mean square; slow_m2: (2,) the mean of that.
        last_step_m2, last_view_m2: (2,) the squares themselves.
        told: lines told the tilt of the last view.
    """

    frames: float = 0.0
    view_frames: float = 0.0
    mean_m: Array = field(default_factory=lambda: np.zeros(2))
    step_m2: Array = field(default_factory=lambda: np.zeros(2))
    sway_m: Array = field(default_factory=lambda: np.zeros(2))
    sway_noise_m2: Array = field(default_factory=lambda: np.zeros(2))
    view_m2: Array = field(default_factory=lambda: np.zeros(2))
    slow_m2: Array = field(default_factory=lambda: np.zeros(2))
    last_step_m2: Array = field(default_factory=lambda: np.zeros(2))
    last_view_m2: Array = field(default_factory=lambda: np.zeros(2))
    told: bool = True


def learn(state: LeanState, ref: Points, curr: Points, ref_from_curr: Array, elapsed_s: float, height_m: float) -> None:
    """Take in a step (3,) between views whose tilt no lines told."""
    found = _by_lean(ref, curr, ref_from_curr, height_m)
    if found is None:
        return
    changed, noise = found
    if np.max(noise) > _VIEW_M**2:  # four points close together: one that is a centimetre off leans them by degrees
        return
    step = _tells(noise, _STEP_M)
    off = changed - state.mean_m
    state.mean_m = state.mean_m + step / (1.0 + state.frames) * off
    excess = off**2 - noise
    state.step_m2 = state.step_m2 + step / (1.0 + state.frames) * (excess - state.step_m2)
    state.last_step_m2 = step * excess
    goes_on = np.exp(-elapsed_s / _SWAY_S)
    state.sway_m = goes_on * state.sway_m + off
    state.sway_noise_m2 = goes_on**2 * state.sway_noise_m2 + noise
    view = _tells(state.sway_noise_m2, _VIEW_M)
    excess = state.sway_m**2 - state.sway_noise_m2
    state.view_m2 = state.view_m2 + view / (1.0 + state.view_frames) * (excess - state.view_m2)
    state.slow_m2 = state.slow_m2 + view / (1.0 + state.view_frames) * (state.view_m2 - state.slow_m2)
    state.last_view_m2 = view * excess
    state.frames, state.view_frames = min(state.frames + step, _FRAMES), min(state.view_frames + view, _FRAMES)


def _tells(noise_m2: Array, sigma_m: float) -> float:
    """From 0 to 1, how well something of sigma_m shows in noise of a variance (2,)."""
    return float(sigma_m**2 / (sigma_m**2 + np.max(noise_m2)))


def step_cov(state: LeanState) -> Array:
    """(2, 2) m^2 of a step's translation."""
    return np.diag(np.maximum(np.maximum(state.step_m2, state.last_step_m2), 0.0))


def view_cov(state: LeanState) -> Array:
    """(2, 2) m^2 that all points of a view share, for those who take views to err each on its own."""
    return _ALIKE * np.diag(np.maximum(np.maximum(state.view_m2, state.last_view_m2), 0.0))


def sway_m(state: LeanState) -> float:
    """Standard deviation by which leans moved a view until a second ago, infinite until they were measured for long
    enough: points that are no part of the ceiling look like a lean at first."""
    known = state.view_frames >= _KNOWN
    return float(np.sqrt(_ALIKE * max(np.max(state.slow_m2), 0.0))) if known else np.inf


def _by_lean(ref: Points, curr: Points, ref_from_curr: Array, height_m: float) -> tuple[Array, Array] | None:
    """(2,) m by which the translation differs where a lean is fitted as well, and (2,) the variance of that by the
    points' own error; None where they do not tell."""
    at = se2.transform(ref_from_curr, curr.xy)
    off = ref.xy[None] - at[:, None]
    off_m = np.where(curr.kind[:, None] == ref.kind[None], np.hypot(off[..., 0], off[..., 1]), np.inf)
    if not off_m.size:
        return None
    j = np.argmin(off_m, axis=1)
    i = np.arange(len(j))
    sigma = np.hypot(curr.sigma_m, ref.sigma_m[j])
    near = off_m[i, j] <= LEANS * _SIGMAS * sigma
    near &= np.argmin(off_m, axis=0)[j] == i
    if np.count_nonzero(near) < _FEWEST:
        return None
    residual, sigma = off[i, j][near] / sigma[near, None], sigma[near]
    jacobian = _jacobian(at[near] - ref_from_curr[:2], height_m) / sigma[:, None, None]
    jacobian, residual = jacobian.reshape(-1, 5), residual.reshape(-1)
    level, leaning = jacobian[:, :3].T @ jacobian[:, :3], jacobian.T @ jacobian
    try:
        level, leaning = np.linalg.inv(level), np.linalg.inv(leaning)
    except np.linalg.LinAlgError:  # all in one place
        return None
    moved = leaning @ (jacobian.T @ residual)
    rest = residual - jacobian @ moved
    scale = (float(rest @ rest) + 1.0) / (
        len(rest) - 5 + 1
    )  # what the lean explains is in sigma, too: it says too much
    noise = scale * np.maximum(np.diag(leaning - _padded(level))[:2], 0.0)
    return (level @ (jacobian[:, :3].T @ residual))[:2] - moved[:2], noise


def _jacobian(arm: Array, height_m: float) -> Array:
    """(N, 2, 5) of points (N, 2), turned into the reference's axes, by a motion and a lean about both axes."""
    x, y = arm.T
    one, none = np.ones_like(x), np.zeros_like(x)
    along = [one, none, -y, height_m + x * x / height_m, x * y / height_m]
    across = [none, one, x, x * y / height_m, height_m + y * y / height_m]
    return np.stack([np.stack(along, axis=-1), np.stack(across, axis=-1)], axis=1)


def _padded(level: Array) -> Array:
    out = np.zeros((5, 5))
    out[:3, :3] = level
    return out
