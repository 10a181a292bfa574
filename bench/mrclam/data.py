"""Reader of recordings in the UTIAS multi-robot format (Leung et al., IJRR 2011), plain or gzipped.

Barcodes.dat, Landmark_Groundtruth.dat, Robot<n>_Groundtruth.dat, Robot<n>_Measurement.dat, Robot<n>_Odometry.dat:
columns of numbers, '#' begins a comment. Measurements name barcodes, not subjects.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ceilvo.errors import FileFormatError
from ceilvo.se2 import compose
from ceilvo.types import Array, Ints

TRUTH_GAP_S = 0.5
"""Over longer gaps of the ground truth nothing is interpolated and nothing is scored."""
MAX_ODOMETRY_S = 1.0
"""A command is believed to hold for no longer than this."""


@dataclass(frozen=True)
class World:
    """subject (L,), xy_m (L, 2); barcode to subject for everything that carries one."""

    subject: Ints
    xy_m: Array
    barcodes: dict[int, int]


@dataclass(frozen=True)
class Run:
    """One robot.

    Attributes:
        odometry: (M, 3) t s, v m/s, w rad/s, in order of time.
        seen_s, subject, range_m, bearing_rad: (K,) landmark observations in order of time, from begin_s to end_s.
        truth: (T, 4) t s, x m, y m, theta rad (unwrapped).
        ignored: observations of other robots, of unknown barcodes, and of times without odometry or truth.
    """

    robot: int
    odometry: Array
    seen_s: Array
    subject: Ints
    range_m: Array
    bearing_rad: Array
    truth: Array
    begin_s: float
    end_s: float
    ignored: dict[str, int]

    def truth_at(self, t_s: Array) -> Array:
        """(..., 3) true poses, nan where the ground truth has a gap."""
        t, at = self.truth[:, 0], np.asarray(t_s, np.float64)
        out = np.stack([np.interp(at, t, self.truth[:, i]) for i in (1, 2, 3)], axis=-1)
        after = np.clip(np.searchsorted(t, at), 1, len(t) - 1)
        out[(t[after] - t[after - 1] > TRUTH_GAP_S) | (at < t[0]) | (at > t[-1])] = np.nan
        return np.asarray(out, np.float64)

    def dead_reckoning(self, t_s: Array) -> Array:
        """(T, 3) poses by odometry alone from the origin at its first record; every command holds until the next."""
        t, v, w = self.odometry.T
        poses = np.zeros((len(t), 3))
        arcs = arc(v[:-1], w[:-1], np.minimum(np.diff(t), MAX_ODOMETRY_S))
        heading = np.concatenate([[0.0], np.cumsum(arcs[:, 2])])
        c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
        poses[1:, 0] = np.cumsum(c * arcs[:, 0] - s * arcs[:, 1])
        poses[1:, 1] = np.cumsum(s * arcs[:, 0] + c * arcs[:, 1])
        poses[:, 2] = heading
        last = np.clip(np.searchsorted(t, t_s, side="right") - 1, 0, len(t) - 1)
        rest = np.clip(np.asarray(t_s) - t[last], 0.0, MAX_ODOMETRY_S)
        return compose(poses[last], arc(v[last], w[last], rest))


def arc(v_m_s: Array, w_rad_s: Array, dt_s: Array) -> Array:
    """(M, 3) displacements of constant speed and turn rate."""
    turn = w_rad_s * dt_s
    small = np.abs(turn) < 1e-9
    radius = v_m_s * dt_s / np.where(small, 1.0, turn)
    x = np.where(small, v_m_s * dt_s, radius * np.sin(turn))
    y = np.where(small, 0.5 * v_m_s * dt_s * turn, radius * (1.0 - np.cos(turn)))
    return np.column_stack([x, y, turn])


def robots_in(folder: Path) -> list[int]:
    """Numbers of the robots that have measurements."""
    found = (re.fullmatch(r"Robot(\d+)_Measurement\.dat(\.gz)?", p.name) for p in folder.iterdir())
    return sorted({int(m[1]) for m in found if m})


def read_world(folder: Path) -> World:
    if not folder.is_dir():
        raise FileFormatError(f"{folder}: no such folder, expected one with Barcodes.dat and Robot<n>_*.dat")
    landmarks = _table(folder, "Landmark_Groundtruth", 3)
    barcodes = _table(folder, "Barcodes", 2)
    subject = landmarks[:, 0].astype(np.int64)
    if len(np.unique(subject)) < len(subject):
        raise FileFormatError(f"{folder}/Landmark_Groundtruth: a subject is there twice, expected each once")
    return World(subject, landmarks[:, 1:3], {int(code): int(s) for s, code in barcodes[:, :2]})


def read_run(folder: Path, robot: int, world: World) -> Run:
    """One robot's recording, cut to where there is odometry and truth."""
    if robot not in robots_in(folder):
        known = ", ".join(map(str, robots_in(folder))) or "none"
        raise FileFormatError(f"{folder}: no measurements of robot {robot}; there are those of {known}")
    odometry = _in_time(_table(folder, f"Robot{robot}_Odometry", 3)[:, :3])
    truth = _in_time(_table(folder, f"Robot{robot}_Groundtruth", 4)[:, :4])
    truth[:, 3] = np.unwrap(truth[:, 3])
    seen = _in_time(_table(folder, f"Robot{robot}_Measurement", 4)[:, :4])
    begin, end = max(odometry[0, 0], truth[0, 0]), min(odometry[-1, 0], truth[-1, 0])
    if not begin < end:
        raise FileFormatError(
            f"{folder}/Robot{robot}: odometry ({odometry[0, 0]:.1f} to {odometry[-1, 0]:.1f} s) and ground truth "
            f"({truth[0, 0]:.1f} to {truth[-1, 0]:.1f} s) do not overlap"
        )
    subject = np.array([world.barcodes.get(int(code), -1) for code in seen[:, 1]], np.int64)
    landmark = np.isin(subject, world.subject)
    inside = (seen[:, 0] >= begin) & (seen[:, 0] <= end)
    sane = (seen[:, 2] > 0.0) & (np.abs(seen[:, 3]) <= 2.0 * np.pi)
    keep = landmark & inside & sane
    if not np.any(keep):
        raise FileFormatError(f"{folder}/Robot{robot}_Measurement: found no landmark of Landmark_Groundtruth in it")
    ignored = {
        "unknown_barcode": int(np.sum(subject < 0)),
        "not_a_landmark": int(np.sum((subject >= 0) & ~landmark)),
        "outside_time": int(np.sum(landmark & ~inside)),
        "not_sane": int(np.sum(landmark & inside & ~sane)),
    }
    at = seen[keep]
    return Run(robot, odometry, at[:, 0], subject[keep], at[:, 2], at[:, 3], truth, float(begin), float(end), ignored)


def _in_time(table: Array) -> Array:
    return np.asarray(table[np.argsort(table[:, 0], kind="stable")], np.float64)


def _table(folder: Path, stem: str, columns: int) -> Array:
    """(R, >= columns) numbers of <stem>.dat or <stem>.dat.gz."""
    path = next((p for p in (folder / f"{stem}.dat", folder / f"{stem}.dat.gz") if p.exists()), None)
    if path is None:
        raise FileFormatError(f"{folder}/{stem}.dat: no such file, nor with .gz")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an empty file is reported below
            table = np.loadtxt(path, ndmin=2)
    except (ValueError, OSError, EOFError) as e:
        raise FileFormatError(f"{path}: cannot be read as a table of numbers: {e}") from None
    if not len(table) or table.shape[1] < columns:
        raise FileFormatError(f"{path}: found {len(table)} rows of {table.shape[1]}, expected {columns} columns")
    if not np.all(np.isfinite(table[:, :columns])):
        row = int(np.flatnonzero(~np.all(np.isfinite(table[:, :columns]), axis=1))[0])
        raise FileFormatError(f"{path}: record {row + 1} is not finite: {table[row]}")
    return np.asarray(table, np.float64)
