"""Configuration: the schema's sections, by their names; reading and checking are in the modules beside it."""

from ceilvo.config.schema import (
    BOUND_SIGMAS,
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
    "BOUND_SIGMAS",
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
