"""Refines a survey round by round (Levenberg and Marquardt)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ceilvo.calibration import Calibration
from ceilvo.crossing_types import LAMP
from ceilvo.daemon.odometry.rigid import rigid_motion
from ceilvo.daemon.refinement.calibration_field import CalibrationField, CalibrationPrior, corrected
from ceilvo.daemon.refinement.equations import ROBUST, Equations, Estimate, Terms, linearised, moved
from ceilvo.daemon.refinement.solver import Solver
from ceilvo.daemon.refinement.straightness import Rows, rows_of
from ceilvo.daemon.refinement.survey import Anchors, Survey
from ceilvo.se2 import transform
from ceilvo.types import Array, Ints

_ROUNDS = 20
"""At most; chosen: five do where the map was nearly right."""
_DONE = 1e-4
"""A round that lessens the cost by less than this share of it is the last."""
_SCALES = (300.0, 30.0, ROBUST)
"""Of the robust loss, one after the other: a map that is bent by metres is straightened before single features are
taken for wrong (graduated non-convexity, Blake and Zisserman 1987)."""
_DAMPING = 1e-6
"""To begin with, relative to the diagonal; ten times less after each round that helped, more after one that did not."""
_MOST_DAMPING = 1e3
_DRAWS = 48
"""Of the errors that are left, for the landmarks' covariances; chosen: they are known to 20 %."""
_NEIGHBOURS = 24
"""A landmark's covariance is about its neighbours, as many as a view shows: what shifts all of them is no error of a
view's, and the filter takes landmarks for independent."""
_LEAST_SHARED = 2
"""Landmarks that two views must share for a place and a heading; with fewer the motion between them counts."""
_FEWEST_MARKS = 2
"""That say where a map lies, and how it is turned."""
BAD_WEIGHT = 0.25
"""Mean weight of a landmark's features below which it is not explained; chosen: 5 standard deviations off."""


@dataclass(frozen=True)
class Refined:
    """The result.

    Attributes:
        estimate: poses, landmarks, correction and direction.
        cov_m2: (L, 2, 2) of the landmarks about their neighbours.
        calibrations: (C,) corrected.
        correction_sigma: (C, 5).
        cost: before and after.
        rounds: how many.
        weight: (O,) of the features at the end.
        unexplained: (U,) landmarks whose features do not fit.
        moved_m: (L,) how far each landmark went, after the map of its floor was laid on what it was.
    """

    estimate: Estimate
    cov_m2: Array
    calibrations: tuple[Calibration, ...]
    correction_sigma: Array
    cost: tuple[float, float]
    rounds: int
    weight: Array
    unexplained: Ints
    moved_m: Array


def refine(
    survey: Survey,
    prior: CalibrationPrior | None = None,
    anchors: Anchors | None = None,
    straight: bool = True,
    on_round: Callable[[int, float], None] = lambda _round, _cost: None,
    seed: int = 0,
    start: Array | None = None,
) -> Refined:
    """The most likely map, poses and calibration.

    Args:
        prior: of the calibration; the default is a careful commissioning's.
        anchors: what a tape or a surveyor measured.
        straight: joints of the ceiling are straight lines.
        on_round: told the round and the cost.
        seed: of the draws for the covariances.
        start: (C, 5) correction of the calibrations to begin with.

    Raises:
        RefinementError: the views do not tie the map together.
    """
    anchors = anchors or Anchors()
    terms = _terms(survey, prior or CalibrationPrior(), anchors, straight)
    solver = Solver(survey.view, survey.landmark, len(survey.pose), len(survey.xy_m), terms.links)
    at = Estimate(
        survey.pose, survey.xy_m, np.zeros((len(survey.calibrations), 5)) if start is None else start, survey.axis_rad
    )
    first, rounds = linearised(terms, at).cost, 0
    for scale in _SCALES:
        at, e, used = _settled(replace(terms, robust=scale), solver, at, on_round, rounds)
        rounds += used
    return _told(survey, solver, e, at, (first, e.cost), rounds, seed)


def _settled(
    terms: Terms, solver: Solver, at: Estimate, on_round: Callable[[int, float], None], before: int
) -> tuple[Estimate, Equations, int]:
    """The estimate and its equations where no step lessens the cost, and the rounds that it took."""
    e, damping = linearised(terms, at), _DAMPING
    for used in range(1, _ROUNDS + 1):
        step = solver.step(e, damping)
        tried = moved(at, step.poses, step.landmarks, step.border)
        after = linearised(terms, tried)
        on_round(before + used, min(after.cost, e.cost))
        if not after.cost <= e.cost:
            damping *= 100.0
            if damping > _MOST_DAMPING:
                break
            continue
        gained, at, e = e.cost - after.cost, tried, after
        damping *= 0.1
        if gained < _DONE * e.cost:
            break
    return at, e, used


def _terms(survey: Survey, prior: CalibrationPrior, anchors: Anchors, straight: bool) -> Terms:
    links = _gaps(survey)
    eye = survey.eye[survey.view]
    fields = (CalibrationField(c, survey.seen_m[eye == k]) for k, c in enumerate(survey.calibrations))
    return Terms(
        survey=survey,
        fields=tuple(fields),
        rows=_rows(survey, straight),
        anchors=anchors,
        prior_sigma=np.array([prior.sigma(c.camera) for c in survey.calibrations]),
        links=links,
        held=_held(survey, links, anchors),
    )


def _rows(survey: Survey, straight: bool) -> Rows:
    """Of each floor."""
    crossings = (survey.crossing_type < LAMP) & straight
    found = [
        rows_of(survey.xy_m, float(axis), crossings & (survey.landmark_floor == f))
        for f, axis in enumerate(survey.axis_rad)
    ]
    return Rows(*(np.concatenate([getattr(r, k) for r in found]) for k in ("pair", "axis", "sigma_m")))


def _held(survey: Survey, links: Ints, anchors: Anchors) -> Ints:
    """The first pose of each part of the survey that is tied to no other, unless two marks of it hold it."""
    poses, landmarks = len(survey.pose), len(survey.xy_m)
    rows, columns = np.append(survey.view, links), np.append(poses + survey.landmark, links - 1)
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(poses + landmarks,) * 2)
    _, part = connected_components(graph, directed=False)
    _, first = np.unique(part[:poses], return_index=True)
    marks = np.bincount(part[poses + np.unique(anchors.mark)], minlength=int(part.max()) + 1)
    return np.asarray(first[marks[part[first]] < _FEWEST_MARKS], np.int64)


def _gaps(survey: Survey) -> Ints:
    """Poses that share too few landmarks with the one before, and that motion ties to it."""
    starts = np.searchsorted(survey.view, np.arange(len(survey.pose) + 1))
    candidates = np.flatnonzero(survey.linked)
    few = [
        k
        for k in candidates
        if len(
            np.intersect1d(survey.landmark[starts[k - 1] : starts[k]], survey.landmark[starts[k] : starts[k + 1]], True)
        )
        < _LEAST_SHARED
    ]
    return np.array(few, np.int64)


def _told(
    survey: Survey, solver: Solver, e: Equations, at: Estimate, cost: tuple[float, float], rounds: int, seed: int
) -> Refined:
    counts = np.maximum(np.bincount(survey.landmark, minlength=len(survey.xy_m)), 1)
    weight = np.bincount(survey.landmark, e.weight, len(survey.xy_m)) / counts
    draws = solver.drawn(e, np.random.default_rng(seed), _DRAWS)
    corrections = zip(survey.calibrations, at.correction, strict=True)
    floors = [survey.landmark_floor == f for f in range(len(survey.axis_rad)) if np.any(survey.landmark_floor == f)]
    return Refined(
        estimate=at,
        cov_m2=np.concatenate([_about_neighbours(at.xy_m[f], draws[:, f]) for f in floors]),
        calibrations=tuple(corrected(c, correction) for c, correction in corrections),
        correction_sigma=np.sqrt(np.diag(solver.border_cov)[: at.correction.size]).reshape(at.correction.shape),
        cost=cost,
        rounds=rounds,
        weight=e.weight,
        unexplained=np.flatnonzero(weight < BAD_WEIGHT),
        moved_m=np.concatenate([_moved_m(survey.xy_m[f], at.xy_m[f]) for f in floors]),
    )


def _moved_m(before_m: Array, after_m: Array) -> Array:
    return np.asarray(np.hypot(*(laid_on(after_m, before_m) - before_m).T))


def _about_neighbours(xy_m: Array, draws: Array) -> Array:
    """(L, 2, 2) covariance of draws (N, L, 2) about the mean of each landmark's neighbours."""
    count = min(_NEIGHBOURS, len(xy_m))
    near = cKDTree(xy_m).query(xy_m, count)[1].reshape(len(xy_m), -1)
    cov = np.zeros((len(xy_m), 2, 2))
    for draw in draws:
        off = draw - draw[near].mean(axis=1)
        cov += off[:, :, None] * off[:, None, :]
    return cov / len(draws)


def laid_on(xy_m: Array, onto_m: Array) -> Array:
    """Points (N, 2) turned and shifted so that they lie best on others, by least squares."""
    return transform(rigid_motion(xy_m, onto_m), xy_m)
