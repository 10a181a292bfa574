"""The loops over single edge points: compiled where a compiler was there when ceilvo was installed, else in NumPy.

reference.py and in_picture.py say what each one computes. Points stand in four groups, one after the other: axis 0
falling, axis 0 rising, axis 1 falling, axis 1 rising along the normal; `ends` are the bounds of the groups. A point's
`rho` is its coordinate along its axis' normal, its `tangent` that along the line, counted along the normal turned by
+90 deg.
"""

from ceilvo.daemon.vision.kernel import reference

_following = _joins = _lines = _pixels = _points = _spreads = _votes = reference
COMPILED = True
try:
    from ceilvo.daemon.vision.kernel import following as _following  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.vision.kernel import joins as _joins  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.vision.kernel import lines as _lines  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.vision.kernel import pixels as _pixels  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.vision.kernel import points as _points  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.vision.kernel import spreads as _spreads  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.vision.kernel import votes as _votes  # type: ignore[attr-defined,no-redef]
except ImportError:
    COMPILED = False

level_points, follow = _pixels.level_points, _following.follow
split, project, assign = _points.split, _points.project, _points.assign
settle, extents = _points.settle, _points.extents
direction, vote, peaks = _votes.direction, _votes.vote, _votes.peaks
spread, crowd, slope_quartiles = _spreads.spread, _spreads.crowd, _spreads.slope_quartiles
align, fit = _lines.align, _lines.fit
picture, join, arms = _joins.picture, _joins.join, _joins.arms
