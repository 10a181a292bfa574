"""Mutated input for every reader of bytes."""
