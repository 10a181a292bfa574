"""Motion from lines where too few of them cross."""
