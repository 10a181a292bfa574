"""Commands and types of their words, for argparse."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from ceilvo.errors import one_line

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[argparse.ArgumentParser]

_NEAR = 0.5
"""Likeness of two words, 0 to 1, from which one may be the other mistyped; chosen: 'rnu' is run."""


def command(commands: Commands, name: str, text: str, example: str) -> argparse.ArgumentParser:
    """A command of a program, with what it does and an example in its help."""
    return commands.add_parser(
        name, help=text, description=text[0].upper() + text[1:] + ".", epilog=f"example: {example}"
    )


def check_word(parser: argparse.ArgumentParser, commands: Commands, words: Sequence[str]) -> None:
    """End with exit code 2 where the first word is no command, naming the ones that it may have been."""
    word = next(iter(words), "-")
    if word.startswith("-") or word in commands.choices:
        return
    import difflib  # a restart has no need of it

    near = difflib.get_close_matches(word, commands.choices, n=2, cutoff=_NEAR)
    hint = f"did you mean {' or '.join(repr(n) for n in near)}?" if near else f"expected {', '.join(commands.choices)}"
    parser.error(f"no command {one_line(word)!r}; {hint}")


def from_up(least: int) -> Callable[[str], int]:
    """The type of a whole number that is not below the least."""

    def number(text: str) -> int:
        value = int(text)
        if value < least:
            raise argparse.ArgumentTypeError(f"{text}: expected at least {least}")
        return value

    return number
