"""What the node publishes, hears and serves: names, types, quality of service."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from ceilvo.config import Ros2
from ceilvo.drivers.ros2.cdr import EMPTY, TRIGGER


class Kind(str, Enum):
    """As rmw_zenoh and zenoh-bridge-ros2dds write it."""

    PUBLISHER = "MP"
    SUBSCRIBER = "MS"
    SERVICE = "SS"


@dataclass(frozen=True, slots=True)
class Endpoint:
    """
    Attributes:
        topic: with its namespace and / in front.
        message: ROS type.
        latched: transient local: whoever comes late gets the last one.
        depth: of the history.
    """

    kind: Kind
    topic: str
    message: str
    latched: bool = False
    depth: int = 10


@dataclass(frozen=True, slots=True)
class Endpoints:
    """Every one of the node, by its part in it. On demand are what `shown` lists."""

    tf: Endpoint
    tf_static: Endpoint
    pose: Endpoint
    odom: Endpoint
    diagnostics: Endpoint
    landmarks: Endpoint
    particles: Endpoint
    image: Endpoint
    camera_info: Endpoint
    initial_pose: Endpoint
    relocalise: Endpoint
    save_map: Endpoint
    fleet: Endpoint

    @property
    def published(self) -> tuple[Endpoint, ...]:
        return (self.tf, self.tf_static, self.pose, self.odom, self.diagnostics, *self.shown)

    @property
    def shown(self) -> tuple[Endpoint, ...]:
        return (self.landmarks, self.particles, self.image, self.camera_info)

    @property
    def served(self) -> tuple[Endpoint, ...]:
        return (self.relocalise, self.save_map)


def endpoints(config: Ros2, robot: str) -> Endpoints:
    """As configured, of a robot of this name."""

    def topic(name: str, message: str, *, latched: bool = False, depth: int = 10) -> Endpoint:
        return Endpoint(Kind.PUBLISHER, absolute(config, name), message, latched, depth)

    pose = "geometry_msgs/msg/PoseWithCovarianceStamped"
    return Endpoints(
        tf=topic(config.tf_topic, "tf2_msgs/msg/TFMessage", depth=100),
        tf_static=topic(f"{config.tf_topic}_static", "tf2_msgs/msg/TFMessage", latched=True, depth=1),
        pose=topic(config.pose_topic, pose, latched=True, depth=1),
        odom=topic(config.odom_topic, "nav_msgs/msg/Odometry"),
        diagnostics=topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
        landmarks=topic("landmarks", "visualization_msgs/msg/MarkerArray", depth=1),
        particles=topic("particles", "geometry_msgs/msg/PoseArray", depth=1),
        image=topic("image/compressed", "sensor_msgs/msg/CompressedImage", depth=1),
        camera_info=topic("camera_info", "sensor_msgs/msg/CameraInfo", depth=1),
        initial_pose=Endpoint(Kind.SUBSCRIBER, absolute(config, "initialpose"), pose),
        relocalise=Endpoint(Kind.SERVICE, absolute(config, "reinitialize_global_localization"), EMPTY),
        save_map=Endpoint(Kind.SERVICE, absolute(config, "save_map"), TRIGGER),
        fleet=Endpoint(Kind.PUBLISHER, f"/{robot}/tf", "tf2_msgs/msg/TFMessage"),
    )


def absolute(config: Ros2, name: str) -> str:
    """A name in the node's namespace, unless it is absolute."""
    namespace = config.namespace.strip("/")
    return name if name.startswith("/") else f"/{namespace}/{name}" if namespace else f"/{name}"
