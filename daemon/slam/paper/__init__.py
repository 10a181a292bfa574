"""The rivals, and the paper to the letter."""
