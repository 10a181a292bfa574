"""Filters that find a lost pose on a map of points by themselves: rivals of the daemon's own belief over places, for the
experiments of the paper and the recorded robots, whose landmarks have labels or ranges and no ceiling."""
