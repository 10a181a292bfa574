"""What senses beside camera and wheels say, as data."""
