"""What the pipeline saw, drawn on pictures."""
