"""A file for each step of commissioning."""
