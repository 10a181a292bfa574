"""Motion by other senses than the eye: wheels whose scales are learnt, a gyro, and by how much each is late."""
