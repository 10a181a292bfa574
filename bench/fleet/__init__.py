"""A fleet of light robots against one map service over Zenoh: kills, hostile robots, bytes."""
