"""Commands and types of their words, for argparse."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[argparse.ArgumentParser]


def command(commands: Commands, name: str, text: str, example: str) -> argparse.ArgumentParser:
    """A command of a program, with what it does and an example in its help."""
    return commands.add_parser(
        name, help=text, description=text[0].upper() + text[1:] + ".", epilog=f"example: {example}"
    )


def from_up(least: int) -> Callable[[str], int]:
    """The type of a whole number that is not below the least."""

    def number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{text}: expected at least {least}")
        return value

    return number
