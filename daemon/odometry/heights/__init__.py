"""Ceilings of more than one height: how high each line is, from how fast it moves past."""
