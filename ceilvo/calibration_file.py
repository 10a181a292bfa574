"""The calibration file: YAML that people read, written by calib, with a version and a checksum.

Layout in docs/files.md. The checksum is SHA-256 over the canonical JSON of everything else in the file.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ceilvo import yaml_nodes
from ceilvo.calibration import Calibration, NoiseCurves
from ceilvo.calibration_check import DISTORTION_COUNTS, check_fits, value_problems
from ceilvo.camera import CameraModel
from ceilvo.errors import CalibrationError, one_line
from ceilvo.files import write_atomic

__all__ = [
    "VERSION",
    "check_fits",
    "parse_calibration",
    "read_calibration",
    "render_calibration",
    "sign_calibration",
    "write_calibration",
]

VERSION = 1
"""Of the file; _MIGRATIONS bring older ones to it."""
_TEXT_CHARS, _SHORT_CHARS = 200, 60
"""Of a text in the file, and of a wrong value in a message, which stays one line."""

_MIGRATIONS: Mapping[int, Callable[[dict[str, Any]], dict[str, Any]]] = {}
"""From version n to n + 1, applied in turn to the content of an old file; version 1 is the first."""

_HEADER = """\
# Calibration of one camera on one robot under one ceiling. Written by calib, read by ceilvod.
# The checksum notices edits: `calib sign FILE` accepts one that is meant.
"""
_CAMERA_KEYS = ("id", "kind", "width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px", "distortion", "readout_s")
_NOISE_KEYS = ("sigma_x_m", "sigma_y_m", "sigma_theta_rad", "r_min_m", "r_max_m")
_KEYS = ("version", "created", "camera", "projection", "noise", "tile_m", "meta", "checksum")


def write_calibration(path: Path, calibration: Calibration, *, force: bool = False) -> None:
    """Write a file whole or not at all.

    Args:
        path: the target; with `force` a file that is there is replaced and kept as `<name>.bak`.
        calibration: checked first; `meta` may hold text, finite numbers, booleans, arrays, lists and mappings.

    Raises:
        CalibrationError: values that read_calibration would refuse, a file in the way, or a disk that refuses.
    """
    text = render_calibration(calibration, str(path))
    try:
        if path.exists():
            if not force:
                raise CalibrationError(f"{path}: found a file there, expected none; pass --force to replace it")
            write_atomic(path.with_name(path.name + ".bak"), path.read_bytes())
        write_atomic(path, text)
    except OSError as e:
        raise CalibrationError(f"{path}: cannot be written ({e.strerror}); check the folder and its rights") from None


def render_calibration(calibration: Calibration, source: str) -> str:
    """The text of a calibration file; `source` names it in messages.

    Raises:
        CalibrationError: values that read_calibration would refuse.
    """
    content = _content(calibration, source)
    problems = list(value_problems(calibration))
    if problems:
        raise CalibrationError(*(f"{source}: {p}" for p in problems))
    content["checksum"] = _checksum(content)
    return _HEADER + yaml_nodes.dump(content)


def read_calibration(path: Path) -> Calibration:
    """The calibration in a file, its checksum and every value checked.

    Raises:
        CalibrationError: everything that is wrong, one line each, also as `.problems`.
    """
    return _read(path, signed=True)


def parse_calibration(text: str, source: str) -> Calibration:
    """read_calibration() of a text; `source` names it in messages."""
    return _parse(lambda: text, source, signed=True)


def sign_calibration(path: Path) -> Calibration:
    """Accept an edited file: check its values, then write it with the right checksum, the edited one kept as .bak.

    Raises:
        CalibrationError: as read_calibration, the checksum aside.
    """
    calibration = _read(path, signed=False)
    write_calibration(path, calibration, force=True)
    return calibration


def _read(path: Path, *, signed: bool) -> Calibration:
    return _parse(lambda: yaml_nodes.read_text(Path(path)), str(path), signed=signed)


def _parse(read: Callable[[], str], path: str, *, signed: bool) -> Calibration:
    try:
        content = yaml_nodes.plain(yaml_nodes.parse(read()))
    except yaml_nodes.YamlProblem as e:
        raise CalibrationError(f"{path}{f':{e.line}' if e.line else ''}: {e.what}") from None
    if not isinstance(content, dict):
        raise CalibrationError(f"{path}: found no keys, expected a calibration; calib writes one")
    content = _migrated(path, content, signed=signed)
    _check_keys(path, content, _KEYS, "", optional=("tile_m", "meta", "checksum"))
    calibration = _calibration(path, content)
    problems = list(value_problems(calibration))
    if problems:
        raise CalibrationError(*(f"{path}: {p}" for p in problems))
    return calibration


def _migrated(path: str, content: dict[str, Any], *, signed: bool) -> dict[str, Any]:
    """The content as VERSION has it, after its checksum was checked as it was written."""
    version = content.get("version")
    if not isinstance(version, int) or isinstance(version, bool) or not 1 <= version <= VERSION:
        newer = isinstance(version, int) and version > VERSION
        hint = "a newer ceilvo wrote it, update this one" if newer else "calib writes a calibration"
        raise CalibrationError(f"{path}: version: found {_short(version)}, expected 1 to {VERSION}; {hint}")
    if signed and content.get("checksum") != (right := _checksum(content)):
        raise CalibrationError(
            f"{path}: checksum: found {_short(content.get('checksum'), 90)}, expected {right!r}; the file was edited "
            "or damaged after calib wrote it: restore it from its .bak or a copy, or accept it with "
            f"'calib sign {path}'"
        )
    for step in range(version, VERSION):
        content = _MIGRATIONS[step](content)
    return content


def _checksum(content: Mapping[str, Any]) -> str:
    rest = {k: v for k, v in content.items() if k != "checksum"}
    try:
        text = json.dumps(rest, sort_keys=True, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    except ValueError:
        return "none, because a number is not finite"
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def _content(c: Calibration, path: str) -> dict[str, Any]:
    camera = c.camera
    return {
        "version": VERSION,
        "created": c.created,
        "camera": {
            "id": c.camera_id,
            "kind": camera.kind,
            "width_px": int(camera.width_px),
            "height_px": int(camera.height_px),
            **{k: float(getattr(camera, k)) for k in ("fx_px", "fy_px", "cx_px", "cy_px")},
            "distortion": [float(k) for k in camera.distortion],
            **({"readout_s": float(camera.readout_s)} if camera.readout_s else {}),
        },
        "projection": np.asarray(c.projection, np.float64).tolist(),
        "noise": {
            "sigma_x_m": [float(k) for k in c.noise.sigma_x_m],
            "sigma_y_m": [float(k) for k in c.noise.sigma_y_m],
            **{k: float(getattr(c.noise, k)) for k in _NOISE_KEYS[2:]},
        },
        "tile_m": None if c.tile_m is None else float(c.tile_m),
        "meta": _simple(c.meta, path, "meta"),
    }


def _simple(value: Any, path: str, key: str) -> Any:
    """A copy in types that YAML has."""
    if isinstance(value, np.ndarray | np.generic):
        return _simple(value.tolist(), path, key)
    if isinstance(value, Mapping) and all(isinstance(k, str) for k in value):
        return {k: _simple(v, path, f"{key}.{k}") for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_simple(v, path, f"{key}[{i}]") for i, v in enumerate(value)]
    if value is None or isinstance(value, str | bool | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    raise CalibrationError(f"{path}: {key}: found {_short(value)}, expected text, finite numbers, lists or mappings")


def _calibration(path: str, content: dict[str, Any]) -> Calibration:
    """Types and sizes; what the values mean is for value_problems."""
    camera, noise = (_mapping(path, content, k) for k in ("camera", "noise"))
    _check_keys(path, camera, _CAMERA_KEYS, "camera.", optional=("readout_s",))
    _check_keys(path, noise, _NOISE_KEYS, "noise.")
    if camera["kind"] not in list(DISTORTION_COUNTS):  # a list may be asked for what has no hash
        raise CalibrationError(f"{path}: camera.kind: found {_short(camera['kind'])}, expected pinhole or fisheye")
    rows = content["projection"]
    if not isinstance(rows, list) or [len(r) if isinstance(r, list) else -1 for r in rows] != [4, 4, 4]:
        raise CalibrationError(f"{path}: projection: found something else, expected 3 rows of 4 numbers (M of eq. 5)")
    tile = content.get("tile_m")
    return Calibration(
        camera=CameraModel(
            kind=camera["kind"],
            width_px=_whole(path, "camera.width_px", camera["width_px"]),
            height_px=_whole(path, "camera.height_px", camera["height_px"]),
            **{k: _number(path, f"camera.{k}", camera[k]) for k in ("fx_px", "fy_px", "cx_px", "cy_px")},
            distortion=_numbers(path, "camera.distortion", camera["distortion"]),
            readout_s=_number(path, "camera.readout_s", camera.get("readout_s", 0.0)),
        ),
        projection=np.array([_numbers(path, f"projection[{i}]", r) for i, r in enumerate(rows)]),
        noise=NoiseCurves(
            sigma_x_m=_numbers(path, "noise.sigma_x_m", noise["sigma_x_m"]),
            sigma_y_m=_numbers(path, "noise.sigma_y_m", noise["sigma_y_m"]),
            **{k: _number(path, f"noise.{k}", noise[k]) for k in _NOISE_KEYS[2:]},
        ),
        camera_id=_text(path, "camera.id", camera["id"]),
        created=_text(path, "created", content["created"]),
        tile_m=None if tile is None else _number(path, "tile_m", tile),
        meta=_mapping(path, content, "meta") if content.get("meta") is not None else {},
    )


def _check_keys(
    path: str, content: Mapping[str, Any], keys: tuple[str, ...], prefix: str, optional: tuple[str, ...] = ()
) -> None:
    missing = [prefix + k for k in keys if k not in content and k not in optional]
    unknown = [prefix + one_line(k, _SHORT_CHARS) for k in content if k not in keys]
    problems = [f"{path}: {k}: found nothing, expected a value; calib writes it" for k in missing]
    problems += [f"{path}: {k}: found an unknown key, expected one of {', '.join(keys)}" for k in unknown]
    if problems:
        raise CalibrationError(*problems)


def _mapping(path: str, content: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = content[key]
    if not isinstance(value, dict):
        raise CalibrationError(f"{path}: {key}: found {_short(value)}, expected keys and values")
    return value


def _number(path: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise CalibrationError(f"{path}: {key}: found {_short(value)}, expected a finite number")
    return float(value)


def _whole(path: str, key: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise CalibrationError(f"{path}: {key}: found {_short(value)}, expected a whole number")
    return value


def _numbers(path: str, key: str, value: Any) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise CalibrationError(f"{path}: {key}: found {_short(value)}, expected a list of numbers")
    return tuple(_number(path, f"{key}[{i}]", v) for i, v in enumerate(value))


def _text(path: str, key: str, value: Any) -> str:
    if not isinstance(value, str) or len(value) > _TEXT_CHARS or not value.isprintable():
        raise CalibrationError(
            f"{path}: {key}: found {_short(value)}, expected up to {_TEXT_CHARS} characters of text in quotes"
        )
    return value


def _short(value: Any, chars: int = _SHORT_CHARS) -> str:
    text = repr(value)
    return text if len(text) <= chars else text[: chars - 3] + "..."
