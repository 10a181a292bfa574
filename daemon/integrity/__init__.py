"""How far the pose can be trusted: states, and whether the calibration still holds."""
