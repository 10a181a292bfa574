"""What a robot keeps of its map over restarts, and what it does with files that are no good."""
