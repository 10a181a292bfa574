"""Recorded robots in the UTIAS multi-robot format."""
