"""Recordings of real ceilings."""
