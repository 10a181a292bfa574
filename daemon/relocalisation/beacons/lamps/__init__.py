"""A few lamps of known place: they look alike, so which one is seen the pose says, or how they lie to each other."""
