"""Which place on the map: searches propose, tests accept."""
