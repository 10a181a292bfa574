"""Two robots' maps of one building, or of two, joined."""
