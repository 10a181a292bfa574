"""One robot in a room: how it drives, what its camera gives, what the daemon said of it."""
