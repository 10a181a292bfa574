"""Commissioning tool."""
