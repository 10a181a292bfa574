"""The map as a thing that lives: on disk, over restarts."""
