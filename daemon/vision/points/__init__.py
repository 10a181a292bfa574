"""Points of the ceiling that are no crossings of lines: lamps, spots, corners."""
