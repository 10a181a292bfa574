"""A robot's side: maps fetched tile by tile, and what was learnt offered."""
