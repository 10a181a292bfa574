"""What the pipeline asks of a pose filter, and the sums over weighted particles that every such filter needs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from ceilvo.errors import CeilvoError
from ceilvo.se2 import compose, wrap_array
from ceilvo.types import Array, FilterHealth, Ints, Landmarks, Motion, Observations


class PoseFilter(Protocol):
    """Estimates map_from_base and the map. Poses are (3,) [m, m, rad], covariances (3, 3)."""

    @property
    def state(self) -> Any:
        """All that the filter remembers, as one dataclass; setting it continues from there."""

    @state.setter
    def state(self, state: Any) -> None: ...

    def reset(self, pose: Array, cov: Array, landmarks: Landmarks | None = None, known: bool = False) -> None:
        """Start again at a pose, with a map or with an empty one.

        known: the map is what it is; nothing is learnt, and its size costs nothing.

        An infinite covariance says that the pose is not known at all. Particles are then spread over the map; a joint
        Gaussian cannot be, and begins at the pose with 1 m and 1 rad. Neither searches. The daemon gives none: where
        the robot is on the map, its relocaliser finds.

        Raises:
            CeilvoError: the covariance is infinite and there is no map.
        """

    def jump(self, pose: Array, cov: Array) -> None:
        """Continue from a pose (3,) with covariance (3, 3) that owes nothing to the map; the map stays."""

    def forget(self, ids: Ints, newborn: bool = False) -> None:
        """Drop landmarks by their ids; all else stays to the bit, as when those are marginalised out.

        Ids that are not there are passed over. A known map stays as it is. Labels are of other landmarks afterwards.

        Args:
            newborn: drop also all that was not seen often enough to be shown.
        """

    def next_id(self) -> int:
        """The least id that no landmark has reached, at no cost."""

    def carry(self, first_id: int, there_from_here: Array) -> Landmarks:
        """Move the landmarks with ids from first_id on by a pose (3,); where it turns them their types are named anew.

        Of what both they and the others know (one type, within upkeep.SAME_M) the others' stays. They keep what they
        know of each other, and the pose stays: jump() is what moves the robot. Costs what is moved.

        Returns:
            Those of them that are shown, as they are now.
        """

    def predict(self, motion: Motion) -> None:
        """Move by the motion since the last call."""

    def update(self, obs: Observations, learnt_from: int = 0) -> None:
        """Weigh against the map; labels index the landmarks() of this moment (types.NO_LANDMARK, UNLABELLED).

        Args:
            learnt_from: landmarks with smaller ids say where the robot is, as well as they are known themselves, and
                learn nothing: no mean, covariance or count of them changes, and none is born, shown, joined or dropped
                (conditional.hold). MAX_ID: no landmark learns. What the view says of the wheels or the lens by such
                landmarks is not learnt either. Of particles the map of each stays as it is, and so does what is
                told of all; but which particles live on the pose decides, and after the doubt what is told follows.
        """

    def estimate(self) -> tuple[Array, Array, FilterHealth]:
        """Pose, covariance and health."""

    def size(self) -> int:
        """How many landmarks there are, at no cost."""

    def landmarks(self) -> Landmarks:
        """The map as estimated; costs its size after every update."""

    def landmarks_near(self, xy_m: Array, reach_m: float) -> tuple[Ints, Landmarks]:
        """Labels, in order, as landmarks() has them, and landmarks within reach of the box around points (M, 2) in map.

        Costs what is there.
        """

    def particles(self) -> tuple[Array, Array]:
        """(N, 3) poses and (N,) weights that sum to one."""

    def counters(self) -> Mapping[str, int]:
        """What happened since the filter was made, by name; the names are in COUNTERS and all are there."""


COUNTERS = (
    "updates",
    "observations",
    "outliers",
    "rejected_updates",
    "births",
    "merges",
    "resamplings",
    "fit_failures",
    "slips",
    "searches",
    "recoveries",
    "tile_slips",
    "faded",
    "map_full",
    "refused",
)
"""Updates; observations matched to a landmark, and those of them that the gate refused; updates most of whose
observations were refused; landmarks born and merged; resamplings, and curves that could not be used; wheel slips that
the landmarks showed; searches for a lost pose begun and ended, and jumps to another tile of a periodic ceiling: of
the benches' filters that recover by themselves, always 0 in the daemon; landmarks dropped because they are no longer
there; features not learnt and newborn landmarks forgotten as the map is full; newborn landmarks forgotten because
they were not seen again."""


TINY = 1e-300
"""In place of a chance of zero, whose logarithm there is not."""
JITTER = np.array([1e-12, 1e-12, 1e-12])
"""m^2, m^2, rad^2: added to a covariance so that it can be inverted; a micrometre and a microradian, squared."""


def checked_motion(motion: Motion) -> Motion:
    """The same motion.

    Raises:
        CeilvoError: it is not finite.
    """
    if not (np.all(np.isfinite(motion.prev_from_curr)) and np.all(np.isfinite(motion.cov))):
        raise CeilvoError(
            f"filter: motion {motion.prev_from_curr} is not finite, expected metres and radians with a finite "
            "covariance; report a failed motion with its prediction instead"
        )
    return motion


def mean_and_cov(poses: Array, weights: Array) -> tuple[Array, Array]:
    """Weighted mean, circular in heading (eq. 20), and covariance of (N, 3) poses."""
    theta = np.arctan2(weights @ np.sin(poses[:, 2]), weights @ np.cos(poses[:, 2]))
    mean = np.array([weights @ poses[:, 0], weights @ poses[:, 1], theta])
    off = np.column_stack([poses[:, :2] - mean[:2], wrap_array(poses[:, 2] - theta)])
    mean[2] = wrap_array(theta + weights @ off[:, 2])  # exact where arctan2 of means is only first order
    return mean, np.asarray((off * weights[:, None]).T @ off, np.float64)


def effective_size(weights: Array) -> float:
    """ESS = 1 / sum w^2."""
    return float(1.0 / np.sum(weights * weights))


def normalised(log_weights: Array) -> Array:
    """Weights that sum to one from logarithms."""
    w = np.exp(log_weights - np.max(log_weights))
    return np.asarray(w / np.sum(w), np.float64)


def spread(mean: Array, cov: Array, n: int, rng: np.random.Generator) -> Array:
    """(n, 3) Gaussian draws whose sample mean is exactly `mean`, so that drawing adds no drift; cov may be singular."""
    values, vectors = np.linalg.eigh(0.5 * (cov + cov.T))
    noise = rng.standard_normal((n, 3))
    noise = (noise - np.mean(noise, axis=0)) * np.sqrt(n / max(n - 1, 1))
    return np.asarray(mean + noise @ (vectors * np.sqrt(np.maximum(values, 0.0))).T, np.float64)


def systematic(weights: Array, rng: np.random.Generator, count: int | None = None) -> Ints:
    """(count,) ancestors by systematic resampling, as many as there are particles unless said otherwise."""
    n = len(weights) if count is None else count
    cdf = np.cumsum(weights)
    steps = (np.arange(n) + rng.random()) / n
    return np.minimum(np.searchsorted(cdf / cdf[-1], steps, side="right"), len(weights) - 1).astype(np.int64)


def moved(poses: Array, motion: Motion, rng: np.random.Generator) -> Array:
    """(N, 3) poses, each after its own draw of the motion."""
    return compose(poses, spread(motion.prev_from_curr, motion.cov, len(poses), rng))


def chi_square_bounds(dof: int, sigmas: float = 3.0) -> tuple[float, float]:
    """Bounds of a mean of squares of dof standard normals that chance keeps (Wilson and Hilferty 1931)."""
    if dof <= 0:
        return 0.0, float("inf")
    v = 2.0 / (9.0 * dof)
    low, high = (1.0 - v + k * sigmas * np.sqrt(v) for k in (-1.0, 1.0))
    return float(max(low, 0.0) ** 3), float(high**3)
