"""Whether picture, wheels and clock tell the same story."""
