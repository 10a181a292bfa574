"""The mathematics of commissioning: from samples to parameters with their sigmas."""
