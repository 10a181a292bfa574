"""Trajectories on disk and the distance between two of them.

TUM: one line a pose, `t x y z qx qy qz qw`, t in seconds with nine decimals (evo reads it). JSONL: one estimate a line.
Both are functions of the estimates alone: no wall clock and no latency, so that two replays write the same bytes.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from types import TracebackType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.daemon.odometry.rigid import rigid_motion
from ceilvo.errors import FileFormatError
from ceilvo.json_values import json_value
from ceilvo.types import Displacement, Estimate, FilterHealth, Motion, Pose, State, Twist

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

Alignment = Literal["none", "first", "se2"]
SCHEMA = 1
"""Of the lines of JSON, their key "v"."""
_STILL_M = 1e-6
"""A robot that moved less stands; chosen: above floating-point noise, below any drive."""
_QUATERNION_TOLERANCE = 1e-2
"""Of a quaternion's length against 1; chosen: takes files with three digits."""
_MATCH_S = 0.01
"""Stamps of one moment differ by this at most; chosen: a third of a frame at 30 Hz."""


def tum_line(stamp_ns: int, pose: Array) -> str:
    """`t x y z qx qy qz qw` of map_from_base (3,); z, qx and qy are 0."""
    x, y, theta = (float(v) for v in pose)
    values = (x, y, 0.0, 0.0, 0.0, *half_angle(theta))
    text = " ".join(f"{round(v, 9) + 0.0:.9f}" for v in values)  # + 0.0: no "-0.000000000"
    return f"{_seconds(stamp_ns)} {text}\n"


def half_angle(theta_rad: float) -> tuple[float, float]:
    """qz and qw of a turn about z."""
    return math.sin(0.5 * theta_rad), math.cos(0.5 * theta_rad)


def _seconds(stamp_ns: int) -> str:
    whole, rest = divmod(abs(stamp_ns), 10**9)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"


def estimate_json(estimate: Estimate) -> str:
    """One line of JSON, keys with units, null for what is not finite; the shortest text that reads back equal."""
    m, d = estimate.motion, estimate.health
    record = {
        "v": SCHEMA,
        "seq": estimate.seq,
        "stamp_ns": estimate.stamp_ns,
        "pose_map_from_base": estimate.pose,
        "cov": estimate.cov,
        "pose_odom_from_base": estimate.odom,
        "twist_base": estimate.twist,
        "state": estimate.state.name,
        "quality": estimate.quality,
        "reason": estimate.reason,
        "motion": {
            "prev_from_curr": m.prev_from_curr,
            "cov": m.cov,
            "inliers": m.inliers,
            "rms_m": m.rms_m,
            "failure": m.failure,
        },
        "depletion": {
            "particles": d.particles,
            "ess": d.ess,
            "unique_ancestors": d.unique_ancestors,
            "fit_residual": d.fit_residual,
            "nis": d.nis,
            "nis_dof": d.nis_dof,
        },
        "crossings": estimate.crossings,
        "landmarks": estimate.landmarks,
    }
    if estimate.floor:
        record["floor"] = estimate.floor
    return json.dumps(json_value(record), separators=(",", ":"), allow_nan=False) + "\n"


def read_estimate(line: bytes) -> Estimate:
    """The estimate in a line of estimate_json(); what is null there is nan, and what is not in it has its default.

    Raises:
        FileFormatError: it is anything else.
    """
    try:
        body = json.loads(line)
        m, d = body["motion"], body["depletion"]
        ess, residual, nis = (_number(d[name]) for name in ("ess", "fit_residual", "nis"))
        ancestors = None if d["unique_ancestors"] is None else int(d["unique_ancestors"])
        return Estimate(
            seq=int(body["seq"]),
            stamp_ns=int(body["stamp_ns"]),
            pose=Pose(_vector(body["pose_map_from_base"])),
            cov=_matrix(body["cov"]),
            odom=Pose(_vector(body["pose_odom_from_base"])),
            twist=Twist(_vector(body["twist_base"])),
            state=State[body["state"]],
            quality=_number(body["quality"]),
            reason=str(body["reason"]),
            motion=Motion(
                prev_from_curr=Displacement(_vector(m["prev_from_curr"])),
                cov=_matrix(m["cov"]),
                inliers=int(m["inliers"]),
                rms_m=_number(m["rms_m"]),
                failure=None if m["failure"] is None else str(m["failure"]),
            ),
            health=FilterHealth(int(d["particles"]), ess, ancestors, residual, nis, int(d["nis_dof"])),
            crossings=int(body["crossings"]),
            landmarks=int(body["landmarks"]),
            floor=str(body.get("floor", "")),
        )
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as e:
        raise FileFormatError(f"estimate {line[:60]!r}: {type(e).__name__}; the recording is damaged") from e


def _number(value: object) -> float:
    return math.nan if value is None else float(value)  # type: ignore[arg-type]


def _vector(values: object) -> Array:
    return np.array(values, np.float64).reshape(3)


def _matrix(values: object) -> Array:
    return np.array(values, np.float64).reshape(3, 3)


class _LineWriter:
    """A text file that estimates are appended to; use it as a context manager."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = path.open("w", encoding="ascii", newline="\n")
        except OSError as e:
            raise FileFormatError(f"{path}: cannot be written: {e.strerror}; check the folder and its owner") from e

    def write(self, estimate: Estimate) -> None:
        """Raises FileFormatError when the disk does not take it."""
        try:
            self._file.write(self._line(estimate))
        except OSError as e:
            raise FileFormatError(f"{self._path}: cannot be written: {e.strerror}; make room and run again") from e

    def _line(self, estimate: Estimate) -> str:
        raise NotImplementedError

    def close(self) -> None:
        try:
            self._file.close()
        except OSError as e:
            raise FileFormatError(f"{self._path}: cannot be written: {e.strerror}; make room and run again") from e

    def __enter__(self) -> _LineWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


class TumWriter(_LineWriter):
    def _line(self, estimate: Estimate) -> str:
        return tum_line(estimate.stamp_ns, estimate.pose)


class JsonlWriter(_LineWriter):
    def _line(self, estimate: Estimate) -> str:
        return estimate_json(estimate)


@dataclass(frozen=True, slots=True)
class Trajectory:
    """stamp_ns (N,) strictly increasing, poses (N, 3) map_from_base [m, m, rad]."""

    stamp_ns: Ints
    poses: Array

    def __len__(self) -> int:
        return len(self.stamp_ns)


def read_tum(path: Path) -> Trajectory:
    """A TUM file as planar poses: z, roll and pitch are dropped. Blank lines and lines that start with # are skipped.

    Raises:
        FileFormatError: no such file, not eight numbers in a line, a quaternion that is not one, stamps that do not
            increase, or no pose at all.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, ValueError) as e:
        raise FileFormatError(f"{path}: cannot be read: {e}; expected a TUM trajectory") from e
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            stamp, pose = _parse(line)
        except ValueError as e:
            raise FileFormatError(f"{path}:{number}: {e}; expected 't x y z qx qy qz qw'") from e
        if stamps and stamp <= stamps[-1]:
            raise FileFormatError(f"{path}:{number}: stamp {_seconds(stamp)} is not after the last; sort the file")
        stamps.append(stamp)
        poses.append(pose)
    if not stamps:
        raise FileFormatError(f"{path}: has no poses; expected lines 't x y z qx qy qz qw'")
    return Trajectory(np.array(stamps, np.int64), np.array(poses))


def _parse(line: str) -> tuple[int, tuple[float, float, float]]:
    words = line.split()
    if len(words) != 8:
        raise ValueError(f"{len(words)} values in the line")
    try:
        seconds = Decimal(words[0])
        stamp = int((seconds * 10**9).to_integral_value()) if abs(seconds) < 9e9 else 2**63
        x, y, _, qx, qy, qz, qw = (float(w) for w in words[1:])
    except (ArithmeticError, ValueError) as e:
        raise ValueError(f"{line[:60]!r} has a value that is not a number") from e
    if not all(map(math.isfinite, (x, y, qx, qy, qz, qw))) or abs(stamp) >= 2**63:
        raise ValueError(f"{line[:60]!r} has a value that is not finite or too large")
    norm = math.sqrt(qx * qx + qy * qy + qz * qz + qw * qw)
    if abs(norm - 1.0) > _QUATERNION_TOLERANCE:
        raise ValueError(f"quaternion of length {norm:.3g}")
    return stamp, (x, y, math.atan2(2.0 * (qw * qz + qx * qy), norm * norm - 2.0 * (qy * qy + qz * qz)))


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """Distance of an estimated trajectory from a reference, over n poses matched by stamp.

    Attributes:
        reference_from_estimated: (3,) the alignment that was applied.
        step_median_m: frame-to-frame translation error, which no alignment can hide or cause.
    """

    n: int
    position_rms_m: float
    position_median_m: float
    position_max_m: float
    heading_rms_rad: float
    heading_median_rad: float
    heading_max_rad: float
    step_median_m: float
    reference_from_estimated: Array


def compare(
    estimated: Path, reference: Path, align: Alignment = "none", tolerance_s: float = _MATCH_S
) -> TrajectoryError:
    """Compare two TUM files; raises FileFormatError when either is bad or no stamps match."""
    est, ref = read_tum(estimated), read_tum(reference)
    i, j = match_stamps(est.stamp_ns, ref.stamp_ns, round(tolerance_s * 1e9))
    if not len(i):
        raise FileFormatError(
            f"{estimated}: no stamp within {tolerance_s:g} s of one in {reference} "
            f"({_span(est)} against {_span(ref)}); the two must share a clock"
        )
    return trajectory_error(est.poses[i], ref.poses[j], align)


def _span(t: Trajectory) -> str:
    return f"{_seconds(int(t.stamp_ns[0]))} to {_seconds(int(t.stamp_ns[-1]))}"


def match_stamps(a_ns: Ints, b_ns: Ints, tolerance_ns: int) -> tuple[Ints, Ints]:
    """Indices (K,) into both, increasing stamps: each of a with its nearest of b, each of b with its nearest of a."""
    nearest_b, nearest_a = _nearest(b_ns, a_ns), _nearest(a_ns, b_ns)
    i = np.arange(len(a_ns))
    good = (np.abs(a_ns - b_ns[nearest_b]) <= tolerance_ns) & (nearest_a[nearest_b] == i)
    return i[good], nearest_b[good]


def _nearest(sorted_ns: Ints, query_ns: Ints) -> Ints:
    right = np.clip(np.searchsorted(sorted_ns, query_ns), 1, max(len(sorted_ns) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(sorted_ns) - 1)
    return np.where(query_ns - sorted_ns[left] <= sorted_ns[right] - query_ns, left, right)


def trajectory_error(estimated: Array, reference: Array, align: Alignment = "none") -> TrajectoryError:
    """Errors of (N, 3) poses against (N, 3) of the same instants, N >= 1."""
    ref_from_est = _alignment(estimated, reference, align)
    moved = se2.compose(ref_from_est, estimated)
    off_m = np.hypot(moved[:, 0] - reference[:, 0], moved[:, 1] - reference[:, 1])
    off_rad = np.abs(se2.wrap_array(moved[:, 2] - reference[:, 2]))
    steps = se2.between(
        se2.between(reference[:-1], reference[1:]),
        se2.between(estimated[:-1], estimated[1:]),
    )
    step_m = np.hypot(steps[:, 0], steps[:, 1])
    return TrajectoryError(
        n=len(estimated),
        position_rms_m=_rms(off_m),
        position_median_m=float(np.median(off_m)),
        position_max_m=float(off_m.max()),
        heading_rms_rad=_rms(off_rad),
        heading_median_rad=float(np.median(off_rad)),
        heading_max_rad=float(off_rad.max()),
        step_median_m=float(np.median(step_m)) if len(step_m) else 0.0,
        reference_from_estimated=ref_from_est,
    )


def _alignment(estimated: Array, reference: Array, align: Alignment) -> Array:
    if align == "none":
        return np.zeros(3)
    spread_m = np.ptp(estimated[:, :2], axis=0).max(initial=0.0)
    if align == "first" or spread_m < _STILL_M:  # positions of a robot that stands do not show the rotation
        return se2.compose(reference[0], se2.inverse(estimated[0]))
    return rigid_motion(estimated[:, :2], reference[:, :2])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def format_error(error: TrajectoryError, names: Sequence[str] = ("estimated", "reference")) -> str:
    """A short plain-text table."""
    e = error
    heading = (math.degrees(v) for v in (e.heading_rms_rad, e.heading_median_rad, e.heading_max_rad))
    rows = [
        f"{names[0]} against {names[1]}, {e.n} poses",
        f"{'':16}{'rms':>9}{'median':>9}{'max':>9}",
        f"{'position [m]':16}{e.position_rms_m:9.4f}{e.position_median_m:9.4f}{e.position_max_m:9.4f}",
        f"{'heading [deg]':16}" + "".join(f"{v:9.3f}" for v in heading),
        f"{'step [m]':16}{'':9}{e.step_median_m:9.5f}",
    ]
    return "\n".join(rows) + "\n"
