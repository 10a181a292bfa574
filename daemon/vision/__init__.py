"""From a frame to crossings of straight lines, in pixels of the level view and metres on the ceiling."""
