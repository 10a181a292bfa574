"""The loops over matched points and followed lines: compiled where a compiler was there at installation, else in NumPy.

reference.py says what each one computes.
"""

from ceilvo.daemon.odometry.kernel import reference

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
alike, calm_difference, line_ratios = _lines.alike, _lines.calm_difference, _lines.line_ratios
lines_seen, lines_followed, lines_measured = _lines.lines_seen, _lines.lines_followed, _lines.lines_measured
