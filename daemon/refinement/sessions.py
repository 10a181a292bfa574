"""A map and its sessions, refined and named again until both fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ceilvo.calibration import Calibration
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.refinement.calibration_field import CalibrationField, CalibrationPrior
from ceilvo.daemon.refinement.measured import Measured
from ceilvo.daemon.refinement.names import names_on, united
from ceilvo.daemon.refinement.refine import Refined, refine
from ceilvo.daemon.refinement.survey import Floor, Survey, index_of, survey_of
from ceilvo.types import Array, Ints, Landmarks

_GATE_M = 0.03
"""A feature is its landmark's when it lies this near on the refined map; chosen: ten times what is left of errors."""
_BESIDE = 4
"""A landmark that too few views show goes with as many that are refined."""
_ONE_VIEW_M, _ONE_VIEW_OFF_M = 2e-3, 0.1
"""Standard deviation of a landmark in one refined view beside that of the feature, and how far from its place by its
neighbours it may be; chosen: maps are bent by less from one view to the next."""


@dataclass(frozen=True)
class RefinedMap:
    """What comes out.

    Attributes:
        floors: the maps, with sessions as given but for their poses and the map's names.
        last: of the last refinement; its survey.
        cost: before the first and after the last.
        rounds: of both.
        renamed: (L,) of each floor, the id that each landmark has now of those that there were.
        features: all, and those that a landmark of the map explains.
    """

    floors: tuple[Floor, ...]
    last: Refined
    survey: Survey
    cost: tuple[float, float]
    rounds: int
    renamed: tuple[Ints, ...]
    features: tuple[int, int]


def refined_map(
    floors: Sequence[Floor],
    calibrations: Sequence[Calibration],
    prior: CalibrationPrior | None = None,
    measured: Measured | None = None,
    on_round: Callable[[int, float], None] = lambda _round, _cost: None,
) -> RefinedMap:
    """Maps refined twice: by the names that their features had, then by those that they have on the refined ones.

    Args:
        measured: by other means than views.

    Raises:
        RefinementError: the views do not tie the map together, or do not show what was measured.
        ValueError: they show no landmark twice.
    """
    measured = measured or Measured()
    survey = survey_of(floors, calibrations)
    first = refine(survey, prior, measured.on(survey), on_round=on_round)
    named, renamed = [], []
    for k, f in enumerate(_after(floors, survey, first, calibrations)):
        placed = _placed(f, calibrations, first.estimate.correction)
        one, now = united(f.landmarks, f.sessions)
        names = names_on(placed, one, _GATE_M)
        sessions = tuple(replace(s, landmark=name) for s, name in zip(f.sessions, names, strict=True))
        named.append(replace(f, landmarks=one, sessions=sessions, axis_rad=float(first.estimate.axis_rad[k])))
        renamed.append(now)
    survey = survey_of(named, calibrations)
    last = refine(
        survey, prior, measured.renamed(floors, renamed).on(survey), on_round=on_round, start=first.estimate.correction
    )
    return RefinedMap(
        floors=tuple(_after(named, survey, last, calibrations)),
        last=last,
        survey=survey,
        cost=(first.cost[0], last.cost[1]),
        rounds=first.rounds + last.rounds,
        renamed=tuple(renamed),
        features=(sum(s.features for f in floors for s in f.sessions), len(survey.view)),
    )


def _after(
    floors: Sequence[Floor], survey: Survey, refined: Refined, calibrations: Sequence[Calibration]
) -> list[Floor]:
    """Floors as they are after a refinement."""
    lengths = [len(s) for f in floors for s in f.sessions]
    poses = iter(np.split(refined.estimate.pose, np.cumsum(lengths)[:-1]))
    out = []
    for k, f in enumerate(floors):
        f = replace(f, sessions=tuple(replace(s, pose=next(poses)) for s in f.sessions))
        own = survey.landmark_floor == k
        if np.any(own):
            landmarks = _moved(f.landmarks, survey, refined, own)
            rest = ~np.isin(f.landmarks.ids, survey.ids[own])
            landmarks = _seen_once(landmarks, rest, _placed(f, calibrations, refined.estimate.correction))
            f = replace(f, landmarks=landmarks)
        out.append(replace(f, axis_rad=float(refined.estimate.axis_rad[k])))
    return out


def _placed(floor: Floor, calibrations: Sequence[Calibration], correction: Array) -> list[KeyPoses]:
    """Sessions whose features are where their corrected calibrations place them."""
    out = []
    for s, eye in zip(floor.sessions, floor.eyes or [0] * len(floor.sessions), strict=True):
        if s.features:
            s = replace(s, xy_base_m=CalibrationField(calibrations[eye], s.xy_base_m).at(correction[eye])[0])
        out.append(s)
    return out


def _moved(landmarks: Landmarks, survey: Survey, refined: Refined, own: NDArray[np.bool_]) -> Landmarks:
    """All landmarks of a floor: those of the survey where they are now, the rest moved as those beside them.

    Args:
        own: (L,) the survey's that are of this floor.
    """
    before, xy, cov = survey.xy_m[own], refined.estimate.xy_m[own], refined.cov_m2[own]
    at = index_of(landmarks.ids, survey.ids[own])
    near = cKDTree(before).query(landmarks.xy_map_m, min(_BESIDE, len(before)))[1].reshape(len(landmarks), -1)
    moved = landmarks.xy_map_m + (xy - before)[near].mean(axis=1)
    there = at >= 0
    return replace(
        landmarks,
        xy_map_m=np.where(there[:, None], xy[at], moved),
        cov_m2=np.where(there[:, None, None], cov[at], landmarks.cov_m2),
    )


def _seen_once(landmarks: Landmarks, rest: NDArray[np.bool_], placed: Sequence[KeyPoses]) -> Landmarks:
    """Those of the rest (L,) that a key pose shows are where it shows them, if that is near where they are thought."""
    names, first = np.unique(np.concatenate([s.landmark for s in placed]), return_index=True)
    at = index_of(landmarks.ids, names)
    xy = np.concatenate([s.xy_map_m for s in placed])[first][at]
    cov = np.concatenate([s.cov_base_m2 for s in placed])[first][at] + _ONE_VIEW_M**2 * np.eye(2)
    near = rest & (at >= 0) & (np.hypot(*(xy - landmarks.xy_map_m).T) < _ONE_VIEW_OFF_M)
    return replace(
        landmarks,
        xy_map_m=np.where(near[:, None], xy, landmarks.xy_map_m),
        cov_m2=np.where(near[:, None, None], cov, landmarks.cov_m2),
    )
