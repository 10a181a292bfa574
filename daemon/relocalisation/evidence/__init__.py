"""How likely a view is at a pose on the map, and at a wrong place of the same ceiling."""
