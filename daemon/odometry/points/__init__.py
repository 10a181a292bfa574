"""Motion from points that are no crossings of lines: each was seen as a whole, and most stand alone."""
