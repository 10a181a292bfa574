"""Which loops run: compiled ones or their NumPy twins."""

import logging

from ceilvo.daemon.odometry import kernel as odometry
from ceilvo.daemon.relocalisation import kernel as relocalisation
from ceilvo.daemon.vision import kernel as vision


def which() -> tuple[bool, str]:
    """Whether all loops, those of vision too, are compiled, and in words which run, with the loss (docs/arm.md)."""
    compiled = [part.COMPILED for part in (vision, odometry, relocalisation)]
    if all(compiled):
        return True, "compiled"
    part = "compiled in part" if any(compiled) else "not compiled"
    return False, (
        f"{part}: NumPy stands in, and a frame takes 2 times as long; 'apt install gcc python3-dev' and install "
        "ceilvo again, or take the package or a wheel with the kernel"
    )


def log_which(log: logging.Logger) -> None:
    """One line; a warning where it costs something."""
    compiled, said = which()
    log.log(logging.INFO if compiled else logging.WARNING, "kernel: %s", said)
