"""The loops over matched points and followed lines: compiled where a compiler was there at installation, else in NumPy.

reference.py says what each one computes.
"""

from ceilvo.daemon.odometry.kernel import reference
from ceilvo.daemon.vision import kernel as of_vision

_homographies = _lines = _views = reference
COMPILED = True
try:
    from ceilvo.daemon.odometry.kernel import followed_lines as _lines  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.odometry.kernel import homographies as _homographies  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.odometry.kernel import views as _views  # type: ignore[attr-defined,no-redef]
except ImportError:
    COMPILED = False

mutual_nearest, median_translation, median_radius = (
    _views.mutual_nearest,
    _views.median_translation,
    _views.median_radius,
)
refined, homography_residuals = _views.refined, _homographies.homography_residuals
alike, calm_difference, grouped, line_ratios = _lines.alike, _lines.calm_difference, _lines.grouped, _lines.line_ratios


def which() -> tuple[bool, str]:
    """Whether all loops, those of vision too, are compiled, and in words which run, with the loss (docs/arm.md)."""
    if of_vision.COMPILED and COMPILED:
        return True, "compiled"
    part = "not compiled" if not (of_vision.COMPILED or COMPILED) else "compiled in part"
    return False, (
        f"{part}: NumPy stands in, and a frame takes 2 times as long; 'apt install gcc python3-dev' and install "
        "ceilvo again, or take the package or a wheel with the kernel"
    )
