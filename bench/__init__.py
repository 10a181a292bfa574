"""Accuracy and speed studies."""
