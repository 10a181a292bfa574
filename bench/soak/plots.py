"""A soak in five rows over time: memory, descriptors and threads, latency, error, state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from ceilvo.bench.soak.fault_plan import Stroke
from ceilvo.bench.soak.parts import Heard, Usage
from ceilvo.bench.soak.poses import Poses
from ceilvo.sim.world import World
from ceilvo.types import State

_COLOURS = {"camera": "tab:red", "base": "tab:green", "zenoh": "tab:blue", "process": "tab:purple", "flood": "tab:gray"}


def draw(heard: Heard, usage: Sequence[Usage], plan: Sequence[Stroke], world: World, t0_ns: int, path: Path) -> Path:
    """Write the plot; strokes are shaded by whom they struck."""
    poses = Poses(heard, world, t0_ns)
    t = np.array([u.t_s for u in usage]) / 60.0
    figure, axes = plt.subplots(5, 1, figsize=(12, 11), sharex=True, layout="constrained")
    axes[0].plot(t, [u.rss_bytes / 1e6 for u in usage])
    axes[0].set_ylabel("RSS (MB)")
    axes[1].plot(t, [u.descriptors for u in usage], label="descriptors")
    axes[1].plot(t, [u.threads for u in usage], label="threads")
    axes[1].legend(loc="upper right")
    axes[2].semilogy(poses.recv_s / 60.0, 1e3 * np.maximum(poses.latency_s, 1e-4), ".", markersize=1)
    axes[2].set_ylabel("stamp to sample (ms)")
    good = poses.state == State.TRACKING
    axes[3].semilogy(poses.recv_s / 60.0, np.maximum(poses.error_m, 1e-5), ".", markersize=1, color="tab:gray")
    axes[3].semilogy(poses.recv_s[good] / 60.0, np.maximum(poses.error_m[good], 1e-5), ".", markersize=1)
    axes[3].axhline(0.3, color="k", linewidth=0.5)
    axes[3].set_ylabel("error (m); TRACKING blue")
    axes[4].plot(poses.recv_s / 60.0, poses.state, ".", markersize=1)
    axes[4].set_yticks(range(len(State)), [s.name for s in State])
    axes[4].set_xlabel("minutes")
    for axis in axes:
        for s in plan:
            axis.axvspan(s.from_s / 60.0, s.to_s / 60.0, color=_COLOURS[s.fault.part], alpha=0.12, linewidth=0)
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path
