"""ROS 2 without ROS: messages in CDR, and what rmw_zenoh, zenoh-bridge-ros2dds and DDS want besides."""
