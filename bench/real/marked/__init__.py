"""Photographs of real ceilings with the straight edges in them marked by hand, and what the finder makes of them."""
