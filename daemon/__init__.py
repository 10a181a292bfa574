"""The localisation pipeline, one module a stage, and the process around it."""
