"""Figures of one run in bounded memory, for the summary that a run ends with (build/run-summary.json)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo import se2
from ceilvo.types import Estimate

Array = NDArray[np.float64]

_LOW_MS, _HIGH_MS, _BINS_PER_OCTAVE = 1e-3, 1e5, 40
"""Range and resolution of latencies: 1 us to 100 s within 2^(1/80), 0.9 %, in 1065 counts."""


class Histogram:
    """Quantiles of positive figures in bounded memory: logarithmic bins."""

    def __init__(self) -> None:
        self._count = np.zeros(math.ceil(math.log2(_HIGH_MS / _LOW_MS) * _BINS_PER_OCTAVE) + 1, np.int64)

    def add(self, value_ms: float) -> None:
        """Values beyond the range count at its ends; nan is ignored."""
        if math.isnan(value_ms):
            return
        clipped = min(max(value_ms, _LOW_MS), _HIGH_MS)
        self._count[int(math.log2(clipped / _LOW_MS) * _BINS_PER_OCTAVE)] += 1

    def __len__(self) -> int:
        return int(self._count.sum())

    def quantile(self, q: float) -> float:
        """The smallest value that at least q of the figures do not exceed; nan without figures."""
        total = len(self)
        if not total:
            return float("nan")
        rank = max(math.ceil(q * total), 1)
        k = int(np.searchsorted(np.cumsum(self._count), rank))
        return float(_LOW_MS * 2.0 ** ((k + 0.5) / _BINS_PER_OCTAVE))


class _Errors:
    """Sum of squares and maximum of a signed error."""

    def __init__(self) -> None:
        self.n, self.max, self._squares = 0, 0.0, 0.0

    def add(self, value: float) -> None:
        self.n += 1
        self.max = max(self.max, abs(value))
        self._squares += value * value

    @property
    def rms(self) -> float | None:
        return math.sqrt(self._squares / self.n) if self.n else None


class RunStatistics:
    """Feed it every estimate; ask for the summary at any time."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._last: Estimate | None = None
        self._first_ns = 0
        self._frames = 0
        self._position, self._heading = _Errors(), _Errors()
        self._latency: dict[str, Histogram] = {}
        self._path_m = 0.0
        self._true_path_m = 0.0
        self._last_truth: Array | None = None
        self._last_error = (0.0, 0.0)

    @property
    def last_error(self) -> tuple[float, float] | None:
        """Position error (m) and signed heading error (rad) of the last frame that had a truth."""
        return self._last_error if self._position.n else None

    @property
    def fps(self) -> float:
        """Frames per second by the frames' own stamps, over the whole run."""
        span_s = self._seconds()
        return (self._frames - 1) / span_s if span_s > 0 else 0.0

    def latency(self) -> dict[str, tuple[float, float]]:
        """Median and p99 (ms) by stage, in the order the stages first appeared."""
        return {stage: (h.quantile(0.5), h.quantile(0.99)) for stage, h in self._latency.items()}

    def add(self, estimate: Estimate, truth: Array | None = None) -> None:
        """Count one frame; truth is map_from_base (3,) at the frame's stamp, when it is known."""
        if self._last is None:
            self._first_ns = estimate.stamp_ns
        else:
            self._path_m += math.hypot(*(estimate.odom - self._last.odom)[:2])
        self._last = estimate
        self._frames += 1
        for stage, value_ms in estimate.latency_ms.items():
            self.add_latency(stage, value_ms)
        if truth is not None:
            self._add_truth(estimate, np.asarray(truth, np.float64))

    def add_latency(self, stage: str, value_ms: float) -> None:
        """A latency that is known only after the estimate was made, such as photon to register."""
        self._latency.setdefault(stage, Histogram()).add(value_ms)

    def _add_truth(self, estimate: Estimate, truth: Array) -> None:
        off_m = math.hypot(*(estimate.pose - truth)[:2])
        off_rad = se2.wrap(float(estimate.pose[2] - truth[2]))
        self._position.add(off_m)
        self._heading.add(off_rad)
        self._last_error = (off_m, off_rad)
        if self._last_truth is not None:
            self._true_path_m += math.hypot(*(truth - self._last_truth)[:2])
        self._last_truth = truth

    def _seconds(self) -> float:
        return 0.0 if self._last is None else (self._last.stamp_ns - self._first_ns) / 1e9

    def summary(
        self, drops: int = 0, telegrams_sent: int = 0, telegrams_failed: int = 0, zenoh_samples: int = 0
    ) -> dict[str, Any]:
        """The figures of build/run-summary.json; null where there was no truth. distance_m is the truth's if known."""
        heading = self._heading.rms
        return {
            "state": self._last.state.name if self._last is not None else "INIT",
            "frames": self._frames,
            "fps": round(self.fps, 3),
            "drops": drops,
            "position_rms_m": _rounded(self._position.rms, 5),
            "position_max_m": _rounded(self._position.max if self._position.n else None, 5),
            "heading_rms_deg": _rounded(math.degrees(heading) if heading is not None else None, 4),
            "latency_ms": {
                stage: {"median": _rounded(median, 4), "p99": _rounded(p99, 4)}
                for stage, (median, p99) in self.latency().items()
            },
            "telegrams_sent": telegrams_sent,
            "telegrams_failed": telegrams_failed,
            "zenoh_samples": zenoh_samples,
            "distance_m": round(self._true_path_m if self._position.n else self._path_m, 3),
            "seconds": round(self._seconds(), 3),
            "seed": self._seed,
        }


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def format_summary(summary: dict[str, Any]) -> str:
    """A short plain-text table of RunStatistics.summary()."""
    s = summary
    error = "no truth to compare with"
    if s["position_rms_m"] is not None:
        error = f"rms {s['position_rms_m'] * 1e3:.1f} mm, max {s['position_max_m'] * 1e3:.1f} mm"
        error += f", heading rms {s['heading_rms_deg']:.3f} deg"
    rows = [
        ("state", s["state"]),
        ("frames", f"{s['frames']} in {s['seconds']:.1f} s = {s['fps']:.2f} fps, {s['drops']} dropped"),
        ("distance", f"{s['distance_m']:.2f} m"),
        ("error", error),
        ("base", f"{s['telegrams_sent']} telegrams sent, {s['telegrams_failed']} failed"),
        ("zenoh", f"{s['zenoh_samples']} samples"),
    ]
    if "recorder" in s:
        r = s["recorder"]
        stopped = f", stopped: {r['stopped']}" if r["stopped"] else ""
        cpu = f", {100 * r['cpu_s'] / s['seconds']:.1f} % of a core" if s["seconds"] else ""
        rows.append(
            ("recorder", f"{r['messages']} messages, {r['dropped']} dropped, {r['bytes'] / 1e6:.1f} MB{cpu}{stopped}")
        )
    for stage, figures in s["latency_ms"].items():
        rows.append((f"{stage} [ms]", f"median {_ms(figures['median'])}  p99 {_ms(figures['p99'])}"))
    width = max(len(name) for name, _ in rows)
    return "".join(f"{name:{width}}  {text}\n" for name, text in rows)


def _ms(value: float | None) -> str:
    return "   -" if value is None else f"{value:7.2f}"
