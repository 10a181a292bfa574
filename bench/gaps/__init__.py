"""What odometry knows without vision, and how often it is right about what else fits: claims against truth."""
