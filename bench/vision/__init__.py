"""The front end against exact truth."""
