"""Time: of a filter's step, and from the exposure to whoever needs the pose."""
