"""Types of the words on a command line, for argparse."""

from __future__ import annotations

import argparse
from collections.abc import Callable


def from_up(least: int) -> Callable[[str], int]:
    """The type of a whole number that is not below the least."""

    def number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{text}: expected at least {least}")
        return value

    return number
