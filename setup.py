"""The compiled kernel; everything else is in pyproject.toml."""

from setuptools import Extension, setup

KERNEL = "daemon/vision/kernel"

# optional: without a compiler the installation goes on, and the same loops run in NumPy
setup(
    ext_modules=[
        Extension(
            f"ceilvo.{KERNEL.replace('/', '.')}.{name}",
            [f"{KERNEL}/{name}.pyx"],
            # no fused multiply-add, which ARM has and the x86-64 of packages has not: the same figures on both
            extra_compile_args=["-O3", "-fno-math-errno", "-fno-trapping-math", "-ffp-contract=off"],
            optional=True,
        )
        for name in ("pixels", "points")
    ],
    options={"build_ext": {"cython_c_in_temp": True}},  # no generated C between the sources
)
