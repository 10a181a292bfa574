"""Many things to do, the same for each: in this process, in several, or on a cluster."""
