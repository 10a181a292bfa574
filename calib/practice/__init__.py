"""A virtual bench to practise on: every step of commissioning without any hardware."""
