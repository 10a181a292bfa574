"""Senses beside camera and wheels, in a running process."""
