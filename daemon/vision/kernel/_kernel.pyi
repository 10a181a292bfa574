from typing import Any

from numpy.typing import NDArray

_Array = NDArray[Any]
_Ends = tuple[int, int, int, int, int]

def level_points(
    mask: _Array,
    dx: _Array,
    dy: _Array,
    lookup: _Array,
    rank: _Array,
    width: int,
    height: int,
    columns: int,
    limit: int,
    uv: _Array,
    phi: _Array,
) -> int: ...
def follow(
    dx: _Array,
    dy: _Array,
    lookup: _Array,
    raw_of_level: _Array,
    lines: _Array,
    width: int,
    height: int,
    columns: int,
    raw_columns: int,
    raw_rows: int,
    low_x: float,
    low_y: float,
    cell: float,
    tilt_a: float,
    tilt_b: float,
    focal: float,
    stride: float,
    reach: float,
    floor: float,
    gate: float,
    strongest: bool,
    x: _Array,
    y: _Array,
    line: _Array,
    looked: _Array,
) -> int: ...
def split(
    uv: _Array, phi: _Array, psi: float, gate: float, scale: float, x: _Array, y: _Array, group: _Array
) -> _Ends: ...
def vote(
    x: _Array,
    y: _Array,
    ends: _Ends,
    c0: float,
    s0: float,
    c1: float,
    s1: float,
    first: float,
    bins: int,
    stride: int,
    votes: _Array,
) -> None: ...
def project(
    x: _Array, y: _Array, half: int, c: float, s: float, about_x: float, about_y: float, rho: _Array, tangent: _Array
) -> None: ...
def assign(
    x: _Array,
    y: _Array,
    rho: _Array,
    tangent: _Array,
    ends: _Ends,
    offset: _Array,
    counts: _Array,
    gate: float,
    line: _Array,
) -> _Ends: ...
def sums(
    rho: _Array, tangent: _Array, line: _Array, half: int, count: _Array, total: _Array, product: _Array
) -> None: ...
def extents(tangent: _Array, line: _Array, low: _Array, high: _Array) -> None: ...
def means(rho: _Array, line: _Array, count: _Array, total: _Array) -> None: ...
def hits(points: _Array, row: _Array, x: float, y: float, low: float, rows: int, bins: int, hit: _Array) -> None: ...
