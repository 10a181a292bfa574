"""The commissioning session on disk, and what its steps share."""
