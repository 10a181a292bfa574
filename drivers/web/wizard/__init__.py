"""Commissioning and the camera's settings in a browser: a process of its own, and what passes between it and pages."""
