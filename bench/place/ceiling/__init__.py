"""Ceilings of rooms and halls, and a fast eye that looks at them."""
