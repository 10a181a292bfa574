"""Keys, tokens, attachments and type hashes: against published values and against zenoh-ros2-sdk."""

from __future__ import annotations

import pytest
from ros2_parts import parts

from ceilvo.drivers.ros2.cdr import EMPTY, TRIGGER, Cdr, dds_name, describe_service
from ceilvo.drivers.ros2.naming import RmwZenoh, Ros2dds, attachment, gid

sdk = pytest.importorskip("zenoh_ros2_sdk")

HASHES = {
    "nav_msgs/msg/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "geometry_msgs/msg/PoseArray": "af0cc36d190e104d546d168d6b39df04fa4b4ccecf59cb4c9ed328d3d5004aa0",
    "sensor_msgs/msg/CompressedImage": "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
}
ZID = "1badc0ffee000000"


@pytest.mark.parametrize("kind", HASHES)
def test_type_hashes(kind: str) -> None:
    assert Cdr().hash(kind) == f"RIHS01_{HASHES[kind]}"
    assert Cdr("humble").hash(kind) == "TypeHashNotSupported"


@pytest.mark.parametrize(
    ("service", "request_", "response"),
    [
        (EMPTY, "uint8 structure_needs_at_least_one_member", "uint8 structure_needs_at_least_one_member"),
        (TRIGGER, "uint8 structure_needs_at_least_one_member", "bool success\nstring message"),
    ],
)
def test_service_hashes_are_the_sdks(service: str, request_: str, response: str) -> None:
    from zenoh_ros2_sdk.utils import compute_service_type_hash

    assert Cdr().hash(service) == compute_service_type_hash(service, request_, response)


def test_a_service_hash_as_rmw_zenohs_design_prints_it() -> None:
    from rosbags.typesys import get_types_from_msg

    cdr, name = Cdr(), "example_interfaces/srv/AddTwoInts"
    cdr.store.register(get_types_from_msg("int64 a\nint64 b", "example_interfaces/msg/AddTwoInts_Request"))
    cdr.store.register(get_types_from_msg("int64 sum", "example_interfaces/msg/AddTwoInts_Response"))
    describe_service(cdr.store, name)
    assert cdr.hash(name) == "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"


def test_rmw_zenohs_keys_and_tokens_are_the_sdks() -> None:
    from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
    from zenoh_ros2_sdk.keyexpr import endpoint_liveliness_keyexpr, node_liveliness_keyexpr, topic_keyexpr

    p = parts(namespace="robot1", domain_id=7)
    naming = RmwZenoh(p.config, p.cdr)
    node = NodeEntity(7, ZID, 0, "ceilvo", "/robot1")
    assert naming.node_token(ZID) == node_liveliness_keyexpr(node)
    for number, e in enumerate((*p.ends.published, p.ends.initial_pose, *p.ends.served), 1):
        kind, name = p.cdr.hash(e.message), dds_name(e.message)
        assert naming.key(e) == topic_keyexpr(7, e.topic, name, kind)
        token = naming.token(e, ZID, number)
        qos = token.rpartition("/")[2]
        entity = EndpointEntity(node, number, EntityKind(e.kind.value), e.topic, name, kind, qos)
        assert token == endpoint_liveliness_keyexpr(entity)


def test_quality_of_service_in_tokens() -> None:
    from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability

    p = parts()
    naming = RmwZenoh(p.config, p.cdr)
    for e in p.ends.published:
        profile = QosProfile.decode(naming.token(e, ZID, 1).rpartition("/")[2])
        assert profile.reliability is QosReliability.RELIABLE
        assert (profile.durability is QosDurability.TRANSIENT_LOCAL) is e.latched
        assert profile.history_depth == e.depth


def test_names_by_hand() -> None:
    p = parts()
    rmw, bridge = RmwZenoh(p.config, p.cdr), Ros2dds()
    odometry = HASHES["nav_msgs/msg/Odometry"]
    assert rmw.key(p.ends.odom) == f"0/odom/nav_msgs::msg::dds_::Odometry_/RIHS01_{odometry}"
    assert rmw.token(p.ends.odom, ZID, 4) == (
        f"@ros2_lv/0/{ZID}/0/4/MP/%/%/ceilvo/%odom/nav_msgs::msg::dds_::Odometry_/RIHS01_{odometry}/1:2:1,10:,:,:,,"
    )
    assert bridge.key(p.ends.image) == "image/compressed"
    assert bridge.token(p.ends.tf_static, ZID, 2) == f"@/{ZID}/@ros2_lv/MP/tf_static/tf2_msgs§msg§TFMessage/:1:1:0,1"
    assert bridge.token(p.ends.image, ZID, 2) == (
        f"@/{ZID}/@ros2_lv/MP/image§compressed/sensor_msgs§msg§CompressedImage/:1:0:0,1"
    )
    assert bridge.token(p.ends.save_map, ZID, 2) == f"@/{ZID}/@ros2_lv/SS/save_map/std_srvs§srv§Trigger"
    named = parts(namespace="/robot1/", pose_topic="amcl_pose", tf_topic="tf").ends
    assert (named.pose.topic, named.tf_static.topic) == ("/robot1/amcl_pose", "/robot1/tf_static")
    assert (named.diagnostics.topic, named.fleet.topic) == ("/diagnostics", "/robot1/tf")


def test_an_attachment_is_what_the_sdk_reads() -> None:
    from zenoh_ros2_sdk.attachment import Attachment

    data = attachment(1, 1_750_000_000_000_000_000, gid("@ros2_lv/x"))
    assert len(data) == 33 and data[16] == 0x10
    read = Attachment.from_bytes(data)
    assert (read.sequence_id, read.timestamp_ns, read.gid) == (1, 1_750_000_000_000_000_000, gid("@ros2_lv/x"))


def test_an_identity_is_xxh3_low_half_first() -> None:
    """XXH3-128 of nothing is 99aa06d3014798d86001c324468d497f (the algorithm's published vector)."""
    assert gid("") == bytes.fromhex("99aa06d3014798d86001c324468d497f")[::-1]
