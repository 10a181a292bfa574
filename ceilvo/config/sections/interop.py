"""Keys of config.yaml for other people's systems: ROS 2, VDA 5050, browsers."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.config.sections.keys import key


@dataclass(frozen=True)
class Ros2:
    domain_id: int = key(0, "ROS_DOMAIN_ID of the nodes that listen", low=0, high=232)
    distribution: str = key(
        "jazzy", "jazzy also for kilted and later; humble has no type hashes", choices=("jazzy", "humble")
    )
    namespace: str = key("", "before the names of node, topics and services, for example robot1; empty for none")
    node: str = key("ceilvo", "name of the node")
    map_frame: str = key("map", "REP-105 frame of the map")
    odom_frame: str = key("odom", "REP-105 frame that drifts and never jumps")
    base_frame: str = key("base_link", "REP-105 frame of the robot's rotation centre")
    camera_frame: str = key("ceiling_camera_optical_frame", "REP-103 optical frame of the camera")
    tf_topic: str = key(
        "/tf", "transforms; static ones on the same name with _static; tf where they have the namespace"
    )
    pose_topic: str = key("pose", "PoseWithCovarianceStamped; amcl_pose in place of nav2's AMCL")
    odom_topic: str = key("odom", "Odometry by vision")
    transform_tolerance_s: float = key(
        0.1, "map -> odom is stamped so much later than the picture, as AMCL does", low=0.0, high=10.0
    )
    odom_to_base: bool = key(False, "publish odom -> base too: only where nobody else does, such as the wheels' driver")
    camera_rate_hz: float = key(2.0, "most pictures a second while somebody subscribes", low=0.1, high=30.0)
    fleet_tf: bool = key(False, "also the key <robot.name>/tf, which Open-RMF's free_fleet reads")
    fleet_frame: str = key("base_footprint", "the robot's frame there")
    dds_interface: str = key(
        "127.0.0.1", "address that DDS uses, loopback unless you say otherwise; empty leaves it to CYCLONEDDS_URI"
    )
    dds: bool = key(False, "also by DDS itself, without Zenoh; needs ceilvo[dds]")


@dataclass(frozen=True)
class Vda5050:
    host: str = key("127.0.0.1", "the MQTT broker")
    port: int = key(1883, "its port; 8883 with TLS", low=1, high=65535)
    ca_file: str = key("", "certificates that the broker's must come from; empty is MQTT without TLS")
    user: str = key("", "MQTT user; empty for none")
    password_file: str = key("", "a file with the user's password")
    interface_name: str = key("uagv", "first level of every topic")
    version: str = key("3.0.0", "of VDA 5050", choices=("3.0.0", "2.1.0"))
    manufacturer: str = key("ceilvo", "in topics and headers; one MQTT level")
    serial_number: str = key("", "in topics and headers; empty is robot.name")
    map_id: str = key("map", "mapId where the pose's message names no map")
    map_sources: tuple[str, ...] = key(
        [], "what links of downloadMap may begin with, https://, http:// or file:///; empty: no map is downloaded"
    )
    state_period_s: float = key(1.0, "period of the state, which is also sent when it changes", low=0.1, high=30.0)
    visualization_period_s: float = key(0.2, "shortest period of the position alone", low=0.05, high=30.0)


@dataclass(frozen=True)
class Web:
    host: str = key(
        "127.0.0.1", "address to listen on; beyond loopback only with a token, and with TLS or behind a proxy"
    )
    port: int = key(8480, "its port; 0 = a free one", low=0, high=65535)
    token_file: str = key("", "a file with the token that every reader and every command must bring; empty for none")
    certificate_file: str = key("", "TLS: the certificate, with those between it and the authority (PEM)")
    key_file: str = key("", "TLS: its private key (PEM)")
    behind_proxy: bool = key(False, "a proxy in front brings TLS and leaves the Host header as it was")
    read_only: bool = key(False, "pages may look and command nothing")
    state_dir: str = key(
        "", "where commissioning and recordings are kept; empty = $STATE_DIRECTORY, else the current folder"
    )
    recording_bytes: int = key(
        500_000_000, "a recording that a page has started ends at this size", low=1_000_000, high=10**12
    )
    rate_hz: float = key(10.0, "poses a second that a page gets", low=1.0, high=30.0)
