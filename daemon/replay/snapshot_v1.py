"""States in recordings of ceilvo 0.1, which named classes and private attributes, as trees of version 2."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

Tree = dict[str, Any]


def is_v1(tree: Any) -> bool:
    """Whether a tree is one of version 1."""
    return isinstance(tree, dict) and "object" in tree


def upgraded(tree: Any) -> Any:
    """The same content as version 2 writes it.

    Raises:
        KeyError, TypeError, ValueError: it is damaged.
    """
    return _Upgrade().value(tree)


class _Upgrade:
    """Values by their numbers, for version 1 wrote one that two places share once."""

    def __init__(self) -> None:
        self._seen: dict[int, Any] = {}

    def value(self, node: Any) -> Any:
        if not isinstance(node, dict) or "float" in node:
            return node
        if "constant" in node or "as_made" in node:
            return None
        if "enum" in node:
            return node["enum"][1]
        if "again" in node:
            return self._seen[node["again"]]
        made = self._seen[node["number"]] = self._made(node)
        return made

    def _made(self, node: Tree) -> Any:
        if "array" in node:
            return {"array": node["array"]}
        if "scalar" in node:
            dtype, data = node["scalar"]
            number = np.frombuffer(base64.b64decode(data, validate=True), np.dtype(dtype))[0].item()
            return {"float": repr(number)} if isinstance(number, float) and not np.isfinite(number) else number
        if "generator" in node:
            return self.value(node["generator"])
        if "dict" in node:
            return {self.value(k): self.value(x) for k, x in node["dict"]}
        for kind in ("tuple", "list", "deque"):
            if kind in node:
                return [self.value(x) for x in node[kind]]
        name = node["object"].rpartition(".")[2]
        content = {k: self.value(x) for k, x in node["fields"].items()}
        return _CLASSES[name](content)


def _renamed(**new_from_old: str) -> Callable[[Tree], Tree]:
    """The fields that are named, under their new names (new="old")."""
    return lambda f: {new: f[old] for new, old in new_from_old.items()}


def _same(f: Tree) -> Tree:
    return f


def _typed(f: Tree) -> Tree:
    return {("crossing_type" if k == "kind" else k): v for k, v in f.items()}


def _pipeline(f: Tree) -> Tree:
    gap = f["_gap"] if f["_gap"]["failure"] is not None else None
    return {
        "seq": f["_seq"],
        "vision": f["_lines"],
        "odometry": f["_odometry"],
        "dead_reckoning": {
            "stamp_ns": f["_stamp_ns"],
            "odom": f["_odom"],
            "twist": f["_twist"],
            "gap": gap,
            "blind_m": f["_blind_m"],
        },
        "schedule": {"travel_m": f["_travel_m"], "turn_rad": f["_turn_rad"], "updated_ns": f["_updated_ns"]},
        "relocaliser": {
            "hypothesis": f["_hypothesis"],
            "contradictions": f["_contradictions"],
            "map_axis_rad": f["_map_axis_rad"],
        },
        "filter": f["_filter"],
        "states": f["_states"],
    }


def _joint_filter(f: Tree) -> Tree:
    return {
        "rng": f["_rng"],
        "joint": f["_joint"],
        "known": f["_known"],
        "now": f["_now"],
        "nis": f["_nis"],
        "nis_dof": f["_nis_dof"],
        "trimmed_nis": f.get("_surprise", 0.0),
        "counters": f["_counters"],
        "rule": None,
    }


def _pfcf(f: Tree) -> Tree:
    rule = _renamed(displacement_m="_way", travel_m="_reported_m", slipping="_slipping", white="_white")(f)
    rule["ess"], rule["fit_residual"] = f["_health"]
    return _joint_filter(f) | {"rule": rule}


def _fast_slam(f: Tree) -> Tree:
    mean, cov = f["_estimate"] or (None, None)
    names = {"poses": "_poses", "weights": "_weights", "maps": "_maps", "candidates": "_candidates"}
    rest = {"rng": "_rng", "health": "_depletion", "counters": "_counters", "known": "_known", "summary": "_summary"}
    return _renamed(**names, **rest)(f) | {"mean": mean, "cov": cov}


_ARRAYS = {"crossing_type": "kind", "sightings": "sightings", "ids": "ids"}
_CLASSES: Mapping[str, Callable[[Tree], Tree]] = {
    "Pipeline": _pipeline,
    "LineFinder": _renamed(
        tilt="_tilt",
        edges="_last",
        tilt_rad="_last_tilt",
        best_noise_px="_clean_px",
        detection_noise_px="_full_px",
        since_detection="_since_full",
        detections="full",
        tracked="verified",
    ),
    "TiltTracker": _renamed(weight="_count", mean_rad="_mean", var_rad2="_square", noise_var_rad2="_noise"),
    "EdgeSet": lambda f: {("coverage" if k == "filled" else k): v for k, v in f.items()},
    "VisualOdometry": _renamed(
        reference="_reference",
        ref_from_prev="_ref_from_prev",
        since_ref_s="_since_ref_s",
        failed_frames="_misses",
        twist="_twist",
        twist_known="_twist_known",
        heading="_heading",
    ),
    "HeadingLock": _renamed(deferred_rad="_open_rad", deferred_var_rad2="_variance"),
    "StateMachine": _renamed(
        current="_state",
        reported="_reported",
        cause="_cause",
        reason="_reason",
        conditions="_causes",
        nis_high="_nis_high",
        nis_lost="_nis_lost",
        nis_mean="_nis_mean",
        vision_score="_vision_score",
        stamp_ns="_stamp_ns",
        vision_ns="_vision_ns",
        good_frames="_good_frames",
        vision_frames="_vision_frames",
        confirmed="_confirmed",
    ),
    "_Agreement": _renamed(count="_votes", holds="holds"),
    "Confirmation": _same,
    "Motion": _same,
    "Crossings": _typed,
    "Landmarks": _typed,
    "Depletion": _same,
    "Pfcf": _pfcf,
    "Ukf": _joint_filter,
    "FastSlam": _fast_slam,
    "JointMap": _renamed(
        **_ARRAYS,
        mean="mean",
        cov="cov",
        label_of="label_of",
        seen_at="seen_at",
        confirmed="confirmed",
        slot="slot",
        table_xy="_xy",
        table_packed="_packed",
        next_id="_next_id",
    ),
    "KnownMap": _renamed(landmarks="landmarks", cell_m="_cell_m"),
    "Tiles": _same,
    "Bank": _same,
    "ParticleMaps": _renamed(
        **_ARRAYS,
        mean="_mean",
        cov="_cov",
        row="_row",
        xy="_xy",
        packed="_packed",
        size="_size",
        next_id="_next_id",
        turn="_turn",
    ),
    "Candidates": _renamed(
        expire_updates="_expire", xy="xy", cov="cov", crossing_type="kind", count="count", age="_age"
    ),
}
