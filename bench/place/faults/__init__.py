"""What happens to robots, as scripts that walk through the conditions of a drive."""
