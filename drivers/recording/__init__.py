"""MCAP files: written by the flight recorder, read by a replay."""
