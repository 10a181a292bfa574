"""What a camera sees besides a flat ceiling: what hangs lower, other heights, a part of the robot itself, walls."""
