"""Other people's filters on the same recording, map and noise: filterpy, particles, stonesoup.

They get what the project's filters get; each is driven the way its documentation shows. All take ranges and bearings as
they are. A library that is not installed is skipped, and that is said.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np

from ceilvo.bench.mrclam.data import World
from ceilvo.bench.mrclam.noise import Noise
from ceilvo.bench.mrclam.run import START_SIGMA, Event, scored
from ceilvo.se2 import compose, wrap, wrap_array
from ceilvo.types import Array

GATE = 9.0  # squared Mahalanobis distance: 3 sigma squared, 98.9 % of chi-square with two degrees of freedom
FLOOR = 0.02
"""Share of outliers in the particle filter's likelihood, spread over 4 m and half a turn, as ours."""
Path = list[tuple[Event, Array, Array, float]]


class Sensor:
    """Measurement and noise of an event's observations."""

    def __init__(self, world: World, noise: Noise) -> None:
        self._at = {int(s): xy for s, xy in zip(world.subject, world.xy_m, strict=True)}
        self._noise = noise

    def each(self, event: Event) -> list[tuple[Array, Array, Array]]:
        """Landmark (2,), z (range, bearing), R (2, 2)."""
        along, across = self._noise.sigmas(event.range_m)
        rows = zip(event.subject, event.range_m, event.bearing_rad, along, across, strict=True)
        return [(self._at[int(s)], np.array([r, b]), np.diag([sr**2, sb**2])) for s, r, b, sr, sb in rows]


def polar(pose: Array, at: Array) -> Array:
    """(range, bearing) of a landmark; pose (..., 3)."""
    d = at - pose[..., :2]
    return np.stack([np.hypot(d[..., 0], d[..., 1]), wrap_array(np.arctan2(d[..., 1], d[..., 0]) - pose[..., 2])], -1)


def motion_noise(pose: Array, event: Event, noise: Noise) -> Array:
    """(3, 3) odometry covariance in the map."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    g = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(g @ noise.motion_cov(event.motion, event.seconds) @ g.T + 1e-12 * np.eye(3), np.float64)


def filterpy_ukf(moments: Sequence[Event], world: World, noise: Noise, particles: int, gated: bool) -> Path:
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    del particles
    sensor = Sensor(world, noise)
    points = MerweScaledSigmaPoints(3, alpha=0.5, beta=2.0, kappa=0.0, subtract=_minus(2))
    ukf = UnscentedKalmanFilter(
        3,
        2,
        1.0,
        hx=polar,
        fx=lambda x, dt, motion: compose(x, motion),
        points=points,
        x_mean_fn=_mean(2),
        z_mean_fn=_mean(1),
        residual_x=_minus(2),
        residual_z=_minus(1),
    )
    ukf.x, ukf.P = moments[0].truth.copy(), np.diag(START_SIGMA**2)

    def step(event: Event) -> tuple[Array, Array]:
        ukf.Q = motion_noise(ukf.x, event, noise)
        ukf.predict(motion=event.motion)
        for at, z, r in sensor.each(event):
            before = ukf.x.copy(), ukf.P.copy()
            ukf.sigmas_f = points.sigma_points(ukf.x, ukf.P)  # earlier updates of this moment have moved the state
            ukf.update(z, R=r, at=at)
            if gated and float(ukf.y @ ukf.SI @ ukf.y) > GATE:
                ukf.x, ukf.P = before
        return ukf.x.copy(), ukf.P.copy()

    return _timed(moments, step)


def _minus(angle: int) -> Callable[[Array, Array], Array]:
    def residual(a: Array, b: Array) -> Array:
        out = np.asarray(a - b, np.float64)
        out[angle] = wrap(out[angle])
        return out

    return residual


def _mean(angle: int) -> Callable[[Array, Array], Array]:
    def mean(points: Array, weights: Array) -> Array:
        out = np.asarray(weights @ points, np.float64)
        reference = points[0, angle]
        out[angle] = wrap(reference + float(weights @ wrap_array(points[:, angle] - reference)))
        return out

    return mean


def particles_bootstrap(moments: Sequence[Event], world: World, noise: Noise, particles: int, gated: bool) -> Path:
    """particles.SMC on a Feynman-Kac model; its random numbers are NumPy's global ones, seeded here."""
    from particles import SMC, FeynmanKac

    del gated
    sensor = Sensor(world, noise)
    rng = np.random.default_rng(1)

    class Model(FeynmanKac):  # type: ignore[misc]
        def M0(self, N: int) -> Array:
            return np.asarray(moments[0].truth + START_SIGMA * rng.standard_normal((N, 3)), np.float64)

        def M(self, t: int, xp: Array) -> Array:
            event = moments[t]
            spread = np.sqrt(np.diagonal(noise.motion_cov(event.motion, event.seconds)))
            return compose(xp, event.motion + spread * rng.standard_normal(xp.shape))

        def logG(self, t: int, xp: Array, x: Array) -> Array:
            total = np.zeros(len(x))
            for at, z, r in sensor.each(moments[t]):
                off = polar(x, at) - z
                off[:, 1] = wrap_array(off[:, 1])
                var = np.diagonal(r)
                inlier = -0.5 * np.sum(off**2 / var + np.log(2.0 * np.pi * var), axis=1)
                outlier = np.log(FLOOR / (4.0 * np.pi))
                total += np.logaddexp(np.log1p(-FLOOR) + inlier, outlier)
            return total

    np.random.seed(1)  # noqa: NPY002  the library resamples with it
    smc = SMC(fk=Model(len(moments)), N=particles, resampling="systematic", ESSrmin=0.5)

    def step(event: Event) -> tuple[Array, Array]:
        next(smc)
        mean = np.asarray(smc.W @ smc.X, np.float64)
        mean[2] = np.arctan2(smc.W @ np.sin(smc.X[:, 2]), smc.W @ np.cos(smc.X[:, 2]))
        off = smc.X - mean
        off[:, 2] = wrap_array(off[:, 2])
        return mean, np.asarray((off * smc.W[:, None]).T @ off + 1e-9 * np.eye(3), np.float64)

    return _timed(moments, step)


def stonesoup_ukf(moments: Sequence[Event], world: World, noise: Noise, particles: int, gated: bool) -> Path:
    from ceilvo.bench.mrclam.stonesoup import Tracker

    del particles
    sensor = Sensor(world, noise)
    tracker = Tracker(moments[0].truth, np.diag(START_SIGMA**2))

    def step(event: Event) -> tuple[Array, Array]:
        tracker.predict(event.motion, motion_noise(tracker.mean, event, noise))
        for at, z, r in sensor.each(event):
            tracker.update(at, z, r, GATE if gated else np.inf)
        return tracker.mean, tracker.cov

    return _timed(moments, step)


def _timed(moments: Sequence[Event], step: Callable[[Event], tuple[Array, Array]]) -> Path:
    out: Path = []
    for event in moments:
        begun = time.process_time()
        pose, cov = step(event)
        out.append((event, pose, cov, time.process_time() - begun))
    return out


PEERS: dict[str, tuple[str, Callable[..., Path], bool]] = {
    "filterpy UKF": ("filterpy", filterpy_ukf, False),
    "filterpy UKF gated": ("filterpy", filterpy_ukf, True),
    "particles bootstrap": ("particles", particles_bootstrap, False),
    "stonesoup UKF": ("stonesoup", stonesoup_ukf, False),
    "stonesoup UKF gated": ("stonesoup", stonesoup_ukf, True),
}


def missing(library: str) -> str | None:
    """Why a library cannot be used, or None."""
    try:
        importlib.import_module(library)
    except ImportError as e:
        return f"{library}: skipped, it is not installed ({e}); pip install 'ceilvo[bench]'"
    return None


def library_version(library: str) -> str:
    try:
        return version(library)
    except PackageNotFoundError:
        return "?"


def localise_peer(name: str, moments: Sequence[Event], world: World, noise: Noise, particles: int) -> dict[str, Any]:
    _, work, gated = PEERS[name]
    return dict(scored(work(moments, world, noise, particles, gated)))
