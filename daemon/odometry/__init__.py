"""From crossings of two frames to the robot's motion, and the prediction over frames that gave none."""
