"""Stone Soup's unscented Kalman filter for a pose on a known map."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import Any

import numpy as np
from stonesoup.base import Property
from stonesoup.models.base import GaussianModel
from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
from stonesoup.models.transition.base import TransitionModel
from stonesoup.predictor.kalman import UnscentedKalmanPredictor
from stonesoup.types.angle import Bearing
from stonesoup.types.array import CovarianceMatrix, StateVector, StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import GaussianState
from stonesoup.updater.kalman import UnscentedKalmanUpdater

from ceilvo.types import Array


class Odometry(TransitionModel, GaussianModel):  # type: ignore[misc]
    """x composed with a displacement, plus noise in the map."""

    motion: Any = Property()
    noise: Any = Property()

    @property
    def ndim_state(self) -> int:
        return 3

    @property
    def ndim(self) -> int:
        return 3

    def covar(self, **_: Any) -> Any:
        return CovarianceMatrix(self.noise)

    def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
        x = state.state_vector
        c, s = np.cos(_floats(x[2])), np.sin(_floats(x[2]))
        dx, dy, dt = self.motion
        out = np.array([_floats(x[0]) + c * dx - s * dy, _floats(x[1]) + s * dx + c * dy, _floats(x[2]) + dt])
        return _as_state(out, x)


class RangeBearing(NonLinearGaussianMeasurement):  # type: ignore[misc]
    """Range and bearing of a landmark."""

    at: Any = Property()

    @property
    def ndim_meas(self) -> int:
        return 2

    def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
        x = state.state_vector
        dx, dy = self.at[0] - _floats(x[0]), self.at[1] - _floats(x[1])
        bearing = np.arctan2(dy, dx) - _floats(x[2])
        rows = [np.hypot(dx, dy), np.array([Bearing(b) for b in np.atleast_1d(bearing)]).reshape(np.shape(bearing))]
        kind = StateVectors if x.ndim == 2 and x.shape[1] > 1 else StateVector
        return kind(np.array([np.atleast_1d(rows[0]), np.atleast_1d(rows[1])], dtype=object))

    def rvs(self, num_samples: int = 1, **_: Any) -> Any:
        raise NotImplementedError


def _floats(row: Any) -> Array:
    return np.asarray(row, np.float64)


def _as_state(rows: Array, like: Any) -> Any:
    many = getattr(like, "ndim", 2) == 2 and like.shape[1] > 1
    return StateVectors(rows) if many else StateVector(rows.reshape(3, 1))


class Tracker:
    """predict() and update() with a gate; mean (3,) and cov (3, 3)."""

    def __init__(self, pose: Array, cov: Array) -> None:
        self._now = datetime(2000, 1, 1)
        self._state: Any = GaussianState(StateVector(pose), CovarianceMatrix(cov), timestamp=self._now)

    @property
    def mean(self) -> Array:
        return np.asarray(self._state.state_vector, np.float64).ravel()

    @property
    def cov(self) -> Array:
        return np.asarray(self._state.covar, np.float64)

    def predict(self, motion: Array, noise: Array) -> None:
        self._now += timedelta(seconds=1)
        predictor = UnscentedKalmanPredictor(Odometry(motion=motion, noise=noise))
        self._state = predictor.predict(self._state, timestamp=self._now)

    def update(self, at: Array, z: Array, r: Array, gate: float) -> None:
        model = RangeBearing(ndim_state=3, mapping=(0, 1), noise_covar=CovarianceMatrix(r), at=at)
        updater = UnscentedKalmanUpdater(model)
        detection = Detection(StateVector([z[0], Bearing(z[1])]), timestamp=self._now, measurement_model=model)
        predicted = updater.predict_measurement(self._state, model)
        off = np.asarray(detection.state_vector - predicted.state_vector, np.float64).ravel()
        if float(off @ np.linalg.solve(np.asarray(predicted.covar, np.float64), off)) > gate:
            return
        self._state = updater.update(SingleHypothesis(self._state, detection, predicted))
