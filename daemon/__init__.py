"""The localisation pipeline, one module a stage, and the process around it."""

import os

# Matrices here are small: a second BLAS thread gains nothing and waits on a busy machine. Read when NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
