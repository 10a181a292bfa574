"""A tiled ceiling: what is asked for, what hangs where, and its picture."""
