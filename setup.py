"""The compiled kernel; everything else is in pyproject.toml."""

import os

from setuptools import Extension, setup

VISION, ODOMETRY, PLACE = (f"daemon/{room}/kernel" for room in ("vision", "odometry", "relocalisation"))
KERNEL = (
    *(f"{VISION}/{name}" for name in ("following", "joins", "lines", "pixels", "points", "spreads", "votes")),
    *(f"{ODOMETRY}/{name}" for name in ("followed_lines", "homographies", "views")),
    *(f"{PLACE}/{name}" for name in ("evidence", "neighbours")),
)

# optional: without a compiler the installation goes on, and the same loops run in NumPy
setup(
    ext_modules=[
        Extension(
            f"ceilvo.{path.replace('/', '.')}",
            [f"{path}.pyx"],
            depends=[f"{VISION}/{name}.pxi" for name in ("groups", "picture", "solve")],
            # no fused multiply-add, which ARM has and the x86-64 of packages has not: the same figures on both
            extra_compile_args=["-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off"],
            optional=True,
        )
        for path in KERNEL
    ],
    # no generated C between the sources
    options={"build_ext": {"cython_c_in_temp": True, "parallel": os.cpu_count()}},
)
