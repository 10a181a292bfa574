"""The loops over landmarks and places: compiled where a compiler was there at installation, else in NumPy.

reference.py says what each one computes.
"""

from ceilvo.daemon.relocalisation.kernel import reference

_neighbours = _evidence = reference
COMPILED = True
try:
    from ceilvo.daemon.relocalisation.kernel import evidence as _evidence  # type: ignore[attr-defined,no-redef]
    from ceilvo.daemon.relocalisation.kernel import neighbours as _neighbours  # type: ignore[attr-defined,no-redef]
except ImportError:
    COMPILED = False

each_of = reference.each_of
pairs, nearest = _neighbours.pairs, _neighbours.nearest
stamped, looked_up, views, alike, scored, missed = (
    _evidence.stamped,
    _evidence.looked_up,
    _evidence.views,
    _evidence.alike,
    _evidence.scored,
    _evidence.missed,
)
