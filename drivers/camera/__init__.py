"""Cameras: V4L2, recordings, and their stand-ins."""
