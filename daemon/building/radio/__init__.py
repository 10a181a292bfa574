"""Radio anchors of a building."""
