"""A ceiling to look at and a robot to drive."""
