"""The compiled kernel; everything else is in pyproject.toml."""

from setuptools import Extension, setup

# optional: without a compiler the installation goes on, and the same loops run in NumPy
setup(
    ext_modules=[
        Extension(
            "ceilvo.daemon.vision.kernel._kernel",
            ["daemon/vision/kernel/_kernel.c"],
            extra_compile_args=["-O3", "-fno-math-errno", "-fno-trapping-math"],
            optional=True,
        ),
    ]
)
