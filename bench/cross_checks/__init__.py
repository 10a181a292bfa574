"""Checks of picture, wheels and stamps: false alarms in hours of drives, and time to notice faults."""
