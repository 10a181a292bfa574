"""Maps beside the one in use: brought here by a fleet manager, and taken at a start of the daemon."""
