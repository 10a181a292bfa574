"""What a refinement says: what moved, what the calibrations are, what is not explained."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ceilvo.calibration_file import write_calibration
from ceilvo.daemon.building.calibrations import Eyes
from ceilvo.daemon.map.database.content import MapContent
from ceilvo.daemon.refinement.calibration_field import UNKNOWNS, CalibrationPrior
from ceilvo.daemon.refinement.equations import ROBUST
from ceilvo.daemon.refinement.refine import BAD_WEIGHT, laid_on
from ceilvo.daemon.refinement.sessions import RefinedMap
from ceilvo.se2 import wrap
from ceilvo.types import Array, Landmarks

MOST_TOLD = 5
"""Landmarks and key poses that are named; chosen: the rest is counted."""


@dataclass(frozen=True)
class Outcome:
    """Floors before and after, the calibrations that saw them, and how it went."""

    before: tuple[MapContent, ...]
    after: tuple[MapContent, ...]
    eyes: Eyes
    refined: RefinedMap


def told(done: Outcome) -> Iterator[str]:
    """Lines for people."""
    survey, last = done.refined.survey, done.refined.last
    for k, (before, after) in enumerate(zip(done.before, done.after, strict=True)):
        own, poses = survey.landmark_floor == k, survey.floor == k
        name = f"floor {after.floor}: " if after.floor else ""
        twice = len(before.landmarks) - len(after.landmarks)
        yield (
            f"{name}{len(before.landmarks)} landmarks, {int(np.sum(poses))} key poses of {len(after.key_poses)} "
            f"sessions; {twice} landmarks had two names"
        )
        if np.any(own):
            was, now = _both(before.landmarks, after.landmarks)
            turned = np.degrees(wrap(after.axis_rad - before.axis_rad))
            shape = _lengths(laid_on(now, was) - was)
            yield f"{name}moved {_lengths(now - was)}; in shape, {shape}; axis {turned:+.3f} deg"
    (shown, explained), cost = done.refined.features, done.refined.cost
    yield (
        f"features: {explained} of {shown} are of landmarks that two views show, {100 * np.mean(last.weight):.1f} % "
        f"weigh; cost {cost[0]:.0f} to {cost[1]:.0f} in {done.refined.rounds} rounds"
    )
    yield from _calibrations(done)
    yield from _unexplained(done)


def _both(before: Landmarks, after: Landmarks) -> tuple[Array, Array]:
    """(N, 2) places of the landmarks that are in both."""
    _, i, j = np.intersect1d(before.ids, after.ids, assume_unique=True, return_indices=True)
    return before.xy_map_m[i], after.xy_map_m[j]


def _lengths(off_m: Array) -> str:
    length = np.hypot(*off_m.T)
    return f"{1e3 * np.sqrt(np.mean(length**2)):.2f} mm rms, {1e3 * length.max():.2f} mm at most"


def _calibrations(done: Outcome) -> Iterator[str]:
    """What was found of each, with standard deviations."""
    last, deg = done.refined.last, np.degrees(1.0)
    for k, (f, c) in enumerate(zip(done.eyes.files, done.eyes.calibrations, strict=True)):
        x, s, new = last.estimate.correction[k], last.correction_sigma[k], last.calibrations[k]
        p, k1 = CalibrationPrior().sigma(c.camera), (c.camera.distortion or (0.0,))[0]
        yield f"{f.file}: calibration found"
        yield (
            f"  height   {c.ceiling_height_m:.4f} to {new.ceiling_height_m:.4f} m ({100 * x[0]:+.3f} +- "
            f"{100 * s[0]:.3f} %, expected +- {100 * p[0]:.2g} %)"
        )
        yield (
            f"  focal    {c.camera.focal_px:.2f} to {new.camera.focal_px:.2f} px ({100 * x[1]:+.3f} +- "
            f"{100 * s[1]:.3f} %, expected +- {100 * p[1]:.2g} %)"
        )
        yield f"  k1       {k1:.5f} to {k1 + x[2]:.5f} (+- {s[2]:.5f}, expected +- {p[2]:.2g})"
        yield (
            f"  tilt     {deg * x[3]:+.3f} and {deg * x[4]:+.3f} deg about x and y (+- {deg * s[3]:.3f} and "
            f"{deg * s[4]:.3f}, expected +- {deg * p[3]:.2g})"
        )


def write_calibrations(done: Outcome, targets: Mapping[int, Path]) -> Iterator[str]:
    """Write corrected calibrations to new files, by their number; lines that say so."""
    last = done.refined.last
    for k, path in targets.items():
        old, found = done.eyes.files[k].file, last.calibrations[k]
        note: dict[str, Any] = {"from": str(old)}
        for name, value, sigma in zip(UNKNOWNS, last.estimate.correction[k], last.correction_sigma[k], strict=True):
            note[name], note[f"{name}_sigma"] = float(value), float(sigma)
        meta = {**found.meta, "refined": note}
        write_calibration(path, replace(found, created=time.strftime("%Y-%m-%d"), meta=meta))
        yield f"{path}: calibration written; {old} stays as it is"


def _unexplained(done: Outcome) -> Iterator[str]:
    survey, last = done.refined.survey, done.refined.last
    weights = [
        np.bincount(at, last.weight, count) / np.maximum(np.bincount(at, minlength=count), 1)
        for at, count in ((survey.landmark, len(survey.xy_m)), (survey.view, len(survey.pose)))
    ]
    seen = np.bincount(survey.view, minlength=len(survey.pose)) > 0
    bad = np.flatnonzero(weights[0] < BAD_WEIGHT), np.flatnonzero((weights[1] < BAD_WEIGHT) & seen)
    at = last.estimate.xy_m, last.estimate.pose[:, :2]
    floors = survey.landmark_floor, survey.floor
    for k, what in enumerate(("landmarks", "key poses")):
        if not len(bad[k]):
            yield f"not explained: no {what}"
            continue
        yield f"not explained: {len(bad[k])} {what}, the worst:"
        for i in bad[k][np.argsort(weights[k][bad[k]])][:MOST_TOLD].tolist():
            who = f"landmark {survey.ids[i]}" if k == 0 else f"key pose {i}"
            floor = done.after[int(floors[k][i])].floor
            where = f"{at[k][i, 0]:.3f},{at[k][i, 1]:.3f}{f' on {floor}' if floor else ''}"
            off = ROBUST * np.sqrt(1.0 / max(float(weights[k][i]), 1e-9) - 1.0)
            yield f"  {who} at {where}: what was seen is {off:.1f} sigma off"
