"""Configuration: the schema's sections, by their names; reading and checking are in the modules beside it."""

from ceilvo.config.fleet_schema import Fleet, Mapd
from ceilvo.config.interop import Ros2, Vda5050, Web
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
    "Fleet",
    "Mapd",
    "Odometry",
    "Recorder",
    "Robot",
    "Ros2",
    "Service",
    "States",
    "Vda5050",
    "Web",
    "Zenoh",
]
