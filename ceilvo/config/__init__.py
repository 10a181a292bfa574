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
from ceilvo.config.sections.beacons import Beacons
from ceilvo.config.sections.fleet import Fleet, Mapd
from ceilvo.config.sections.interop import Ros2, Vda5050, Web
from ceilvo.config.sections.senses import Senses

__all__ = [
    "Base",
    "Beacons",
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
    "Senses",
    "Service",
    "States",
    "Vda5050",
    "Web",
    "Zenoh",
]
