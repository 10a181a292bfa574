"""Laps with faults, faster than real time."""
