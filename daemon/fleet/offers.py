"""What a robot offers: landmarks as it measured them since it last offered, signed with its key."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.crossing_types import CROSSING_TYPES
from ceilvo.daemon.fleet.keys import KEY_BYTES, SIGNATURE_BYTES, Signer, is_signed
from ceilvo.daemon.fleet.wire import Fields, WireError, packed
from ceilvo.daemon.map.database.rows import LATEST_S, digest
from ceilvo.json_values import MAX_ANGLE_RAD, MAX_ID
from ceilvo.types import Array, Ints

KIND, ENVELOPE = "offer.1", "signed_offer.1"
MOST_ROWS = 1500
"""Of an offer: 50 KB; more are several offers."""
STEP_M = 2.0**-16
"""Of places; chosen: a hundredth of what one drive knows, and int32 reaches 32 km."""
LEAST_SIGMA_M, MOST_SIGMA_M = 1e-4, 100.0
"""Of a landmark along any direction; chosen: nobody is surer, and one that is vaguer says nothing."""
MOST_COUNT = 10_000
"""Of sightings in one offer; chosen: an hour at one place."""
COLUMNS: tuple[tuple[str, str], ...] = (
    ("ref", "<i8"),
    *((name, "<i4") for name in ("x", "y")),
    *((name, "<f4") for name in ("xx", "xy", "yy")),
    ("kind", "u1"),
    *((name, "<u2") for name in ("seen", "expected")),
)
ROW_BYTES = sum(np.dtype(kind).itemsize for _, kind in COLUMNS)
MEASURED = np.dtype(
    [
        ("ref", "<i8"),
        *((name, "<f8") for name in ("x", "y", "xx", "xy", "yy")),
        *((name, "<i8") for name in ("kind", "seen", "expected")),
    ]
)
Measured = NDArray[Any]
"""(N,) of MEASURED: `ref` is the id in the fleet's map, or -1 - id for one that is the robot's own; place (m) and
covariance (m2) are what the robot measured itself, the fleet's knowledge taken out; the counts are since its last
offer."""


@dataclass(frozen=True)
class Offer:
    """
    Attributes:
        service: names the building.
        seq: ascends with every offer of a key.
        base: version of the floor that the robot localised on; 0 for none.
        axis_rad: direction in the map of axis 0 of the types.
        session: the drive, as in KeyPoses.
        begun_s, last_s: its wall-clock times, s since 1970.
    """

    service: str
    floor: str
    robot: str
    seq: int
    base: int
    axis_rad: float
    session: str
    begun_s: float
    last_s: float
    rows: Measured

    def packed(self) -> bytes:
        """
        Raises:
            WireError: there are too many rows, or a value does not go over the wire.
        """
        if len(self.rows) > MOST_ROWS:
            raise WireError(f"{KIND}: {len(self.rows)} landmarks, expected {MOST_ROWS} or fewer; send several")
        names = ("service", "floor", "robot", "seq", "base", "axis_rad", "session", "begun_s", "last_s")
        return packed(KIND, {name: getattr(self, name) for name in names} | {"rows": _bytes(self.rows)})

    @staticmethod
    def unpacked(data: bytes) -> Offer:
        """
        Raises:
            WireError: it is none, or says what no robot can have measured.
        """
        f = Fields(KIND, data)
        return Offer(
            f.text("service"),
            f.text("floor"),
            f.text("robot"),
            f.whole("seq", 1, MAX_ID),
            f.whole("base", 0, MAX_ID),
            f.number("axis_rad", MAX_ANGLE_RAD),
            f.text("session"),
            f.number("begun_s", LATEST_S),
            f.number("last_s", LATEST_S),
            _rows(f.raw("rows")),
        )


def _bytes(rows: Measured) -> bytes:
    values = {name: rows[name] for name, _ in COLUMNS}
    for name in ("x", "y"):
        values[name] = np.round(rows[name] / STEP_M)
        if not np.all(np.abs(values[name]) < 2**31):
            raise WireError(
                f"{KIND}: a landmark's {name} is beyond {STEP_M * 2**31:.0f} m; put the map's origin nearer"
            )
    values["xy"] = rows["xy"] * (1.0 - 1e-6)  # still a covariance after rounding to single precision
    for name in ("seen", "expected"):
        values[name] = np.minimum(rows[name], MOST_COUNT)
    return b"".join(values[name].astype(kind).tobytes() for name, kind in COLUMNS)


def _rows(raw: bytes) -> Measured:
    if not raw or len(raw) % ROW_BYTES or len(raw) > MOST_ROWS * ROW_BYTES:
        raise WireError(f"{KIND}: rows are {len(raw)} bytes, expected 1 to {MOST_ROWS} landmarks of {ROW_BYTES} bytes")
    count, start = len(raw) // ROW_BYTES, 0
    out = np.empty(count, MEASURED)
    for name, kind in COLUMNS:
        values = np.frombuffer(raw, kind, count, start)
        start += values.nbytes
        out[name] = values
    for name in ("x", "y"):
        out[name] *= STEP_M
    problem = rows_problem(out)
    if problem:
        raise WireError(f"{KIND}: {problem}")
    return out


def rows_problem(rows: Measured) -> str:
    """What no robot can have measured, "" where all is possible."""
    if not np.all(np.isfinite(rows["xx"]) & np.isfinite(rows["xy"]) & np.isfinite(rows["yy"])):
        return "a covariance is not finite"
    with np.errstate(over="ignore", invalid="ignore"):
        half, mean = 0.5 * (rows["xx"] - rows["yy"]), 0.5 * (rows["xx"] + rows["yy"])
        spread = np.hypot(half, rows["xy"])
        low, high = mean - spread, mean + spread
    if not np.all((low >= 0.99 * LEAST_SIGMA_M**2) & (high <= 1.01 * MOST_SIGMA_M**2)):
        return f"a covariance is not one of sigmas from {LEAST_SIGMA_M:g} to {MOST_SIGMA_M:g} m"
    if np.any(rows["kind"] >= CROSSING_TYPES):
        return f"a kind is {int(rows['kind'].max())}, expected 0 to {CROSSING_TYPES - 1}"
    if np.any(rows["expected"] > MOST_COUNT) or np.any(rows["seen"] > rows["expected"]):
        return f"counts are not seen <= expected <= {MOST_COUNT}"
    if np.any(np.abs(rows["ref"]) > MAX_ID):
        return "a landmark's name is too large"
    if len(np.unique(rows["ref"])) != len(rows):
        return "a landmark is named twice"
    return ""


def places_of(rows: Measured) -> Array:
    """(N, 2) m."""
    return np.column_stack([rows["x"], rows["y"]])


def covariances_of(rows: Measured) -> Array:
    """(N, 2, 2) m2."""
    return np.column_stack([rows[name] for name in ("xx", "xy", "xy", "yy")]).reshape(-1, 2, 2)


def measured(ref: Ints, xy_m: Array, cov_m2: Array, kind: Ints, seen: Ints, expected: Ints) -> Measured:
    out = np.empty(len(ref), MEASURED)
    out["ref"], out["kind"], out["seen"], out["expected"] = ref, kind, seen, expected
    out["x"], out["y"] = np.reshape(xy_m, (-1, 2)).T
    out["xx"], out["xy"], _, out["yy"] = np.reshape(cov_m2, (-1, 4)).T
    return out


@dataclass(frozen=True)
class Signed:
    """An offer as it goes over the wire.

    Attributes:
        public: the key that it says it is signed with.
        body: the packed offer.
    """

    public: bytes
    signature: bytes
    body: bytes

    @property
    def id(self) -> bytes:
        """Names the offer."""
        return digest(self.public + self.body)

    def is_genuine(self, service: str) -> bool:
        """Whether the key signed it, for this service."""
        return is_signed(self.public, self.signature, _context(service, self.body))

    def packed(self) -> bytes:
        return packed(ENVELOPE, {"key": self.public, "signature": self.signature, "body": self.body})

    @staticmethod
    def unpacked(data: bytes) -> Signed:
        """
        Raises:
            WireError: it is none.
        """
        f = Fields(ENVELOPE, data)
        return Signed(f.raw("key", KEY_BYTES), f.raw("signature", SIGNATURE_BYTES), f.raw("body"))


def signed(offer: Offer, signer: Signer) -> Signed:
    body = offer.packed()
    return Signed(signer.public, signer.sign(_context(offer.service, body)), body)


def _context(service: str, body: bytes) -> bytes:
    """What is signed: an offer to one building is none to another."""
    return b"\n".join([KIND.encode(), service.encode("utf-8", "surrogatepass"), body])
