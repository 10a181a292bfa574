"""Lines too faint for single pixels: evidence is summed along them before it is judged."""
