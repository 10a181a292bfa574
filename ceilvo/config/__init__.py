"""Configuration: the schema's sections, by their names; reading and checking are in the modules beside it."""

from ceilvo.config.schema import (
    Base,
    CalibrationFile,
    Camera,
    Config,
    Features,
    Filter,
    Odometry,
    Recorder,
    Robot,
    Service,
    States,
    Zenoh,
)

__all__ = [
    "Base",
    "CalibrationFile",
    "Camera",
    "Config",
    "Features",
    "Filter",
    "Odometry",
    "Recorder",
    "Robot",
    "Service",
    "States",
    "Zenoh",
]
