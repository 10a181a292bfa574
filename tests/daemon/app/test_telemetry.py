"""What the screen and the health message say of the place: what the belief over places has, not the filter."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from ceilvo.bench.place.case import drive_in
from ceilvo.bench.place.ceiling.worlds import WorldSpec, make_world
from ceilvo.daemon.app.telemetry import Telemetry
from ceilvo.drivers.camera.capture import CaptureCounters, CaptureLoop

_CAPTURE = SimpleNamespace(
    counters=CaptureCounters, rate=SimpleNamespace(camera_hz=10.0, used_period_s=0.1, every_nth=1)
)


def test_a_doubt_of_the_place_is_in_health_and_on_the_screen() -> None:
    drive = drive_in(make_world(WorldSpec("5", 0.6, "raster", 1)), np.random.default_rng(1), True, 10.0, True, 0.5)
    telemetry = Telemetry(drive.estimator, cast(CaptureLoop, _CAPTURE), None, None, None, lambda: 0, 0)
    drive.at_truth()
    drive.go(30.0)
    sure = told(drive.estimator, telemetry)
    drive.estimator.relocalise()
    doubted = told(drive.estimator, telemetry)
    assert sure < 1e-4 < 0.01 < doubted <= 1.0


def told(estimator: Any, telemetry: Telemetry) -> float:
    """Probability of another place, the same in both; nothing else tells it."""
    estimator.silence("the camera gives no frames")
    counters: dict[str, Any] = telemetry.counters()
    assert counters["elsewhere"] == telemetry.snapshot("", "", None, ()).elsewhere == estimator.elsewhere()
    assert counters["filter"]["mode_weight"] == 1.0
    assert {counters["filter"][k] for k in ("searches", "recoveries", "tile_slips")} == {0}
    return float(counters["elsewhere"])
