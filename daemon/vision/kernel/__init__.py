"""The loops over single edge points: compiled where a compiler was there when ceilvo was installed, else in NumPy."""

from ceilvo.daemon.vision.kernel import reference

_pixels = _points = reference
COMPILED = True
try:
    from ceilvo.daemon.vision.kernel import pixels as _pixels  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.vision.kernel import points as _points  # type: ignore[attr-defined,no-redef]
except ImportError:
    COMPILED = False

level_points, follow = _pixels.level_points, _pixels.follow
split, vote, project, assign = _points.split, _points.vote, _points.project, _points.assign
sums, extents, means, hits = _points.sums, _points.extents, _points.means, _points.hits
