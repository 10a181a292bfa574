"""Plots for the record, by matplotlib when it is installed; without it they are left out, and that is said once."""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ceilvo.calib.session.session import Session

Figure: Any = None
with contextlib.suppress(ImportError):  # an extra, not a dependency
    from matplotlib.figure import Figure

MISSING = "plots left out: matplotlib is not installed (pip install 'ceilvo[calib]')"


def save(session: Session, name: str, svg: str | None) -> None:
    if svg is None:
        print(MISSING, file=sys.stderr)
        return
    session.write(name, svg)


def _axes(x: str, y: str) -> tuple[Any, Any]:
    figure = Figure(figsize=(6.0, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(alpha=0.3)
    return figure, axes


def _svg(figure: Any) -> str:
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def radial(rings: Sequence[Mapping[str, float]]) -> str | None:
    """Residuals of the lens model against the distance from the principal point."""
    if Figure is None:
        return None
    figure, axes = _axes("distance from the principal point [px]", "residual [px]")
    r = [g["r_px"] for g in rings]
    axes.plot(r, [g["rms_px"] for g in rings], "o-", label="rms")
    axes.plot(r, [g["along_px"] for g in rings], "s--", label="mean along the radius")
    axes.axhline(0.0, color="grey", lw=0.8)
    axes.legend()
    return _svg(figure)


def sigma(curves: Mapping[str, Mapping[str, Any]]) -> str | None:
    """sigma(r) with its band and what was measured."""
    if Figure is None:
        return None
    figure, axes = _axes("r, distance from the point below the camera [m]", "sigma [mm]")
    for (name, c), colour in zip(curves.items(), ("tab:blue", "tab:orange"), strict=False):
        r = np.asarray(c["r_m"])
        axes.fill_between(r, 1e3 * np.asarray(c["low_m"]), 1e3 * np.asarray(c["high_m"]), alpha=0.2, color=colour)
        fitted = np.polynomial.polynomial.polyval(r, c["coefficients"])
        axes.plot(r, 1e3 * fitted, color=colour, label=f"sigma_{name}")
        axes.plot(c["circle_r_m"], 1e3 * np.asarray(c["circle_sigma_m"]), "o", color=colour)
    axes.set_ylim(bottom=0.0)
    axes.legend()
    return _svg(figure)


def scatter(samples: Mapping[str, Sequence[float]]) -> str | None:
    """Observed positions about the true one, as the paper's fig. 2, coloured by distance."""
    if Figure is None:
        return None
    figure, axes = _axes("error in x [cm]", "error in y [cm]")
    dots = axes.scatter(
        1e2 * np.asarray(samples["dx_m"]), 1e2 * np.asarray(samples["dy_m"]), c=samples["r_m"], marker="*", s=22
    )
    axes.plot(0.0, 0.0, marker="p", ms=13, color="tab:red")
    axes.set_aspect("equal", adjustable="datalim")
    figure.colorbar(dots, label="r [m]")
    return _svg(figure)


def paths(spin_xy_m: Sequence[Sequence[float]], run_xy_m: Sequence[Sequence[float]]) -> str | None:
    """The camera's circle in the spin and the base's run."""
    if Figure is None:
        return None
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    for k, (xy, title) in enumerate(((spin_xy_m, "camera in the spin"), (run_xy_m, "base in the run"))):
        axes = figure.add_subplot(1, 2, k + 1)
        p = np.asarray(xy)
        axes.plot(p[:, 0], p[:, 1], ".-")
        axes.set_title(title)
        axes.set_xlabel("x [m]")
        axes.set_aspect("equal", adjustable="datalim")
        axes.grid(alpha=0.3)
    return _svg(figure)
