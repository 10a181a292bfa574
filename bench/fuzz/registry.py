"""All readers of bytes from outside, by name."""

from __future__ import annotations

from collections.abc import Mapping

from ceilvo.bench.fuzz.engine.target import Target
from ceilvo.bench.fuzz.targets import (
    bus,
    cameras,
    commissioning,
    fleet,
    map_databases,
    pipeline_inputs,
    recordings,
    serial_line,
    settings,
    state_files,
)

TARGETS: Mapping[str, Target] = {
    **settings.TARGETS,
    **state_files.TARGETS,
    **map_databases.TARGETS,
    **serial_line.TARGETS,
    **bus.TARGETS,
    **cameras.TARGETS,
    **pipeline_inputs.TARGETS,
    **recordings.TARGETS,
    **commissioning.TARGETS,
    **fleet.TARGETS,
}
