"""Figures of robust statistics that several rooms use."""

MAD_TO_SIGMA = 1.4826
"""Standard deviation of normal noise over its median absolute deviation: 1 / Phi^-1(3/4)."""
