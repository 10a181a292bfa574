"""A virtual bench to practise on, and what commissioning is worth on it."""
