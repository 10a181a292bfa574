"""A map and its sessions, refined and named again until both fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ceilvo.calibration import Calibration
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.refinement.calibration_field import CalibrationField, CalibrationPrior
from ceilvo.daemon.refinement.names import names_on, united
from ceilvo.daemon.refinement.refine import Refined, refine
from ceilvo.daemon.refinement.survey import Anchors, Survey, survey_of
from ceilvo.types import Array, Landmarks

_GATE_M = 0.03
"""A feature is its landmark's when it lies this near on the refined map; chosen: ten times what is left of errors."""
_BESIDE = 4
"""A landmark that too few views show goes with as many that are refined."""

FindAnchors = Callable[[Survey], Anchors]


@dataclass(frozen=True)
class RefinedMap:
    """What comes out.

    Attributes:
        landmarks, axis_rad: the map.
        sessions: as given, with refined poses and the map's names.
        last: of the last refinement; its survey.
        united: landmarks that had two names.
        features: all, and those that a landmark of the map explains.
    """

    landmarks: Landmarks
    axis_rad: float
    sessions: tuple[KeyPoses, ...]
    last: Refined
    survey: Survey
    united: int
    features: tuple[int, int]


def refined_map(
    sessions: Sequence[KeyPoses],
    landmarks: Landmarks,
    axis_rad: float,
    calibration: Calibration,
    prior: CalibrationPrior | None = None,
    anchors: FindAnchors = lambda _survey: Anchors(),
    on_round: Callable[[int, float], None] = lambda _round, _cost: None,
) -> RefinedMap:
    """The map refined twice: by the names that its features had, then by those that they have on the refined one.

    Args:
        anchors: what was measured, by the indices of a survey's landmarks.

    Raises:
        RefinementError: the views do not tie the map together.
        ValueError: they show no landmark twice.
    """
    survey = survey_of(sessions, landmarks, axis_rad, calibration)
    first = refine(survey, prior, anchors(survey), on_round=on_round)
    better = _with(landmarks, survey, first)
    poses = first.estimate.pose
    one, doubles = united(better, sessions)
    names = names_on(_placed(sessions, calibration, first.estimate.correction), poses, one, _GATE_M)
    named = [replace(s, landmark=name) for s, name in zip(_at(sessions, poses), names, strict=True)]
    survey = survey_of(named, one, first.estimate.axis_rad, calibration)
    last = refine(survey, prior, anchors(survey), on_round=on_round, start=first.estimate.correction)
    explained = len(survey.view)
    return RefinedMap(
        landmarks=_with(one, survey, last),
        axis_rad=last.estimate.axis_rad,
        sessions=tuple(_at(named, last.estimate.pose)),
        last=last,
        survey=survey,
        united=doubles,
        features=(sum(s.features for s in sessions), explained),
    )


def _at(sessions: Sequence[KeyPoses], poses: Array) -> list[KeyPoses]:
    """Sessions at poses (K, 3), one session after the other."""
    ends = np.cumsum([len(s) for s in sessions])
    return [replace(s, pose=part) for s, part in zip(sessions, np.split(poses, ends[:-1]), strict=True)]


def _placed(sessions: Sequence[KeyPoses], calibration: Calibration, correction: Array) -> list[KeyPoses]:
    """Sessions whose features are where the corrected calibration places them."""
    xy = np.concatenate([s.xy_base_m for s in sessions])
    placed, _ = CalibrationField(calibration, xy).at(correction)
    ends = np.cumsum([s.features for s in sessions])
    return [replace(s, xy_base_m=part) for s, part in zip(sessions, np.split(placed, ends[:-1]), strict=True)]


def _with(landmarks: Landmarks, survey: Survey, refined: Refined) -> Landmarks:
    """All landmarks: those of the survey where they are now, the rest moved as those beside them."""
    xy, cov = refined.estimate.xy_m, refined.cov_m2
    order = np.argsort(survey.ids)
    at = order[np.minimum(np.searchsorted(survey.ids[order], landmarks.ids), len(order) - 1)]
    own = survey.ids[at] == landmarks.ids
    near = cKDTree(survey.xy_m).query(landmarks.xy_map_m, min(_BESIDE, len(survey.xy_m)))[1].reshape(len(landmarks), -1)
    moved = landmarks.xy_map_m + (xy - survey.xy_m)[near].mean(axis=1)
    return replace(
        landmarks,
        xy_map_m=np.where(own[:, None], xy[at], moved),
        cov_m2=np.where(own[:, None, None], cov[at], landmarks.cov_m2),
    )
