"""From crossings of two frames to the robot's motion, and the way over frames that gave none."""
