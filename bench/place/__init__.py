"""Faults of a robot that should know its place, through the daemon's own path."""
