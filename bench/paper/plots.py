"""Figures 1 to 9 of the paper, drawn from this bench's own runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ceilvo.bench.paper.filters import WITHOUT_PARTICLES, make
from ceilvo.bench.paper.run import START_SIGMA, Cell, observed
from ceilvo.bench.paper.world import ROOM_M, SETTINGS, Recording, record, room_scene
from ceilvo.daemon.slam.paper import curve_fit
from ceilvo.daemon.slam.pose_filter import systematic
from ceilvo.errors import CeilvoError
from ceilvo.types import Array, Landmarks

COLOURS = {
    "ukf": "tab:gray",
    "ukf_gated": "k",
    "pf": "tab:orange",
    "control": "tab:green",
    "pfcf_paper": "tab:purple",
    "joint": "tab:red",
}
RUNS = (("fig3_ukf", "ukf"), ("fig4_pf", "pf"), ("fig5_joint", "joint"), ("fig5_pfcf_paper", "pfcf_paper"))
AGAINST_N = (
    ("fig6_feature_average", "feature_mean_m", "average feature error (m)"),
    ("fig7_position_average", "position_mean_m", "average position error (m)"),
    ("fig8_feature_maximum", "feature_max_m", "maximum feature error (m)"),
    ("fig9_position_maximum", "position_max_m", "maximum position error (m)"),
)
RUN_PARTICLES = 100  # in figures 3 to 5; chosen, the middle of PARTICLES
_ELLIPSE_CHI2 = 5.991  # 95 % of chi-square with two degrees of freedom

Results = Mapping[Cell, Mapping[str, Any]]


def draw(results: Results, folder: Path, seed: int) -> list[Path]:
    """Write all figures that can be drawn; without matplotlib say so in the error."""
    try:
        import matplotlib
    except ImportError:
        raise CeilvoError("pictures: matplotlib is missing; pip install 'ceilvo[bench]' or --no-pictures") from None
    matplotlib.use("Agg")
    folder.mkdir(parents=True, exist_ok=True)
    out = [_resampling(folder, seed), _noise(folder, seed)]
    out += [_run(folder, file, name, seed) for file, name in RUNS]
    return out + [_against_n(results, folder, *spec) for spec in AGAINST_N]


def against_n(results: Results) -> dict[str, Any]:
    """{setting: {figure: {filter: {N: mean over the seeds}}}}; filters without particles are at N = 0."""
    cells: dict[tuple[str, str, str, int], list[float]] = {}
    for c, f in results.items():
        if c.experiment == "lap":
            for _, figure, _ in AGAINST_N:
                cells.setdefault((c.setting, figure, c.filter, c.particles), []).append(float(f[figure]))
    out: dict[str, Any] = {}
    for (setting, figure, name, n), values in sorted(cells.items()):
        out.setdefault(setting, {}).setdefault(figure, {}).setdefault(name, {})[n] = float(np.mean(values))
    return out


def _saved(figure: Any, path: Path) -> Path:
    import matplotlib.pyplot as plt

    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _resampling(folder: Path, seed: int) -> Path:
    """Fig. 1: particles and weights along one axis, the fitted curve, and what is drawn from it."""
    import matplotlib.pyplot as plt

    rng = np.random.default_rng([seed, 1])
    x = rng.normal(0.0, 0.05, 60)
    likelihood = np.exp(-0.5 * ((x - 0.03) / 0.03) ** 2)
    weights = likelihood / np.sum(likelihood)
    poses = np.column_stack([x, np.zeros(60), np.zeros(60)])
    coefficients = curve_fit.fit(x, len(x) * weights, 4)
    grid = np.linspace(x.min(), x.max(), 200)
    drawn = curve_fit.redraw(poses, weights, 4, rng)
    figure, (top, below) = plt.subplots(2, 1, figsize=(7, 5), sharex=True, height_ratios=(3, 1))
    top.plot(x, len(x) * weights, "o", mfc="none", color="tab:blue", label="particles before, N w")
    top.plot(grid, curve_fit.evaluate(coefficients, x, grid), color="k", label="S*(x), degree 4 (eq. 21)")
    top.axhline(0.0, color="0.8", zorder=0)
    top.set_ylabel("weight x N")
    top.legend()
    below.plot(x, np.zeros(60), "o", mfc="none", color="tab:blue")
    if drawn is not None:
        below.plot(drawn[0][:, 0], np.ones(60), "o", mfc="none", color="tab:red")
    below.plot(x[systematic(weights, rng)], np.full(60, 2.0), "o", mfc="none", color="tab:orange")
    below.set_yticks([0, 1, 2], ["before", "along the curve", "systematic"])
    below.set_ylim(-0.5, 2.5)
    below.set_xlabel("x (m)")
    return _saved(figure, folder / "fig1_resampling.png")


def _noise(folder: Path, seed: int) -> Path:
    """Fig. 2: sigma against distance, and where a feature 1.2 m away is observed."""
    import matplotlib.pyplot as plt

    world, rng = SETTINGS["P"], np.random.default_rng([seed, 2])
    r = np.linspace(0.0, 1.6, 100)
    at = np.array([1.2, 0.0])
    cloud = at + world.sigma(np.array([1.2])) * rng.standard_normal((200, 2))
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
    left.plot(r, world.sigma(r), color="k", label="the world's")
    left.plot(r, world.assumed * world.sigma(r), "--", color="k", label=f"assumed, x{world.assumed:g}")
    left.set_xlabel("distance r (m)")
    left.set_ylabel("sigma_x = sigma_y (m)")
    left.legend()
    right.plot(*(100 * cloud.T), "*", color="tab:blue", label="observed")
    right.plot(*(100 * at), "kp", ms=12, label="real")
    right.set_aspect("equal")
    right.set_xlabel("x in base (cm)")
    right.set_ylabel("y in base (cm)")
    right.legend()
    return _saved(figure, folder / "fig2_observation.png")


def _run(folder: Path, file: str, name: str, seed: int) -> Path:
    """Figs. 3 to 5: one lap, true and estimated, with the 95 % ellipses of the features."""
    import matplotlib.pyplot as plt

    world = np.random.default_rng([seed, 0, 0])
    recording = record(SETTINGS["P"], room_scene(world), world)
    path, features = _followed(recording, name, seed)
    truth = np.array([s.truth for s in recording.steps])
    figure, axes = plt.subplots(figsize=(6, 6))
    axes.plot(*recording.scene.xy_m.T, "kp", ms=9, label="features")
    axes.plot(truth[:, 0], truth[:, 1], color="tab:purple", label="robot")
    axes.plot(path[:, 0], path[:, 1], color="tab:red", label="estimate")
    for centre, cov in zip(features.xy_map_m, features.cov_m2, strict=True):
        axes.plot(*_ellipse(centre, cov).T, color="tab:red", lw=1)
    axes.set(xlim=(0, ROOM_M), ylim=(0, ROOM_M), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    n = "" if name in WITHOUT_PARTICLES else f", N = {RUN_PARTICLES}"
    error = np.hypot(*(path[:, :2] - truth[:, :2]).T)
    axes.set_title(f"{name}{n}, setting P, seed {seed}: rms {np.sqrt(np.mean(error**2)):.3f} m")
    axes.legend(loc="center")
    return _saved(figure, folder / f"{file}.png")


def _followed(recording: Recording, name: str, seed: int) -> tuple[Array, Landmarks]:
    f = make(name, RUN_PARTICLES, SETTINGS["P"], np.random.default_rng([seed, 0, 1]))
    f.reset(recording.start, np.diag(START_SIGMA**2))
    path = []
    for step in recording.steps:
        observations = observed(step, recording.scene, f.landmarks())
        f.predict(step.motion)
        f.update(observations)
        path.append(f.estimate()[0])
    return np.array(path), f.landmarks()


def _ellipse(centre: Array, cov: Array) -> Array:
    values, vectors = np.linalg.eigh(cov)
    a = np.linspace(0.0, 2.0 * np.pi, 60)
    circle = np.column_stack([np.cos(a), np.sin(a)])
    return np.asarray(centre + circle * np.sqrt(_ELLIPSE_CHI2 * np.maximum(values, 0.0)) @ vectors.T, np.float64)


def _against_n(results: Results, folder: Path, file: str, figure_name: str, label: str) -> Path:
    """Figs. 6 to 9, a panel for each setting."""
    import matplotlib.pyplot as plt

    found = against_n(results)
    figure, panels = plt.subplots(1, max(len(found), 1), figsize=(5 * max(len(found), 1), 4), squeeze=False)
    for axes, (setting, figures) in zip(panels[0], found.items(), strict=False):
        for name, values in figures[figure_name].items():
            if name in WITHOUT_PARTICLES:
                axes.axhline(values[0], color=COLOURS[name], ls="--", label=name)
            else:
                axes.plot(list(values), list(values.values()), "o-", color=COLOURS[name], label=name)
        axes.set(title=setting, xlabel="number of particles", ylabel=label, xscale="log")
        axes.legend()
    return _saved(figure, folder / f"{file}.png")
