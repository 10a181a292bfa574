"""Manual pages and bash completion of the commands, from their parsers: `python packaging/manual.py FOLDER`.

Writes FOLDER/PROGRAM.1 (man, groff's macros) and FOLDER/PROGRAM.bash for each program. Nothing in them depends on the
day or the machine but what SOURCE_DATE_EPOCH, seconds since 1970, gives as the date of the pages.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from datetime import datetime, timezone
from pathlib import Path

from ceilvo import __version__
from ceilvo.calib import cli as calib
from ceilvo.daemon import cli as daemon

PROGRAMS = {"ceilvod": daemon.parser_of, "calib": calib.parser_of}
FILES = {
    "/etc/ceilvo/config.yaml": "configuration",
    "/etc/ceilvo/calibration.yaml": "calibration of the camera, written by calib",
    "/var/lib/ceilvo": "map, last pose and recordings",
}
EXITS = {
    "ceilvod": {"0": "fine", "1": "failed", "2": "wrong use", "78": "wrong configuration or calibration"},
    "calib": {"0": "PASS", "1": "FAIL, or failed", "2": "wrong use", "78": "wrong input", "130": "interrupted"},
}
Parser = argparse.ArgumentParser


def commands(parser: Parser) -> dict[str, tuple[str, Parser]]:
    """Name of each command that help lists, to what it does and its parser; {} where there are none."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            told = {str(choice.dest): choice.help or "" for choice in action._choices_actions}
            return {name: (text, action.choices[name]) for name, text in told.items()}
    return {}


def options(parser: Parser) -> Iterator[argparse.Action]:
    """Options and words that help lists, without the commands."""
    for action in parser._actions:
        if action.help != argparse.SUPPRESS and not isinstance(action, argparse._SubParsersAction):
            yield action


def tree(parser: Parser, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Parser]]:
    """The parser and all below it, each with the words that lead to it."""
    yield words, parser
    for name, (_, below) in commands(parser).items():
        yield from tree(below, (*words, name))


# -- the page


def page(program: str, parser: Parser, day: str) -> str:
    """A manual page; `day` as in 2026-11-23."""
    summary = (parser.description or program).rstrip(".")
    lines = [
        f'.TH {program.upper()} 1 "{day}" "ceilvo {__version__}" "User Commands"',
        ".SH NAME",
        f"{program} \\- {_roff(summary[0].lower() + summary[1:])}",
        ".SH SYNOPSIS",
        f".B {program}",
        _roff(_usage(parser)),
        ".SH DESCRIPTION",
        _roff(parser.description or ""),
        *_options(parser),
        ".SH COMMANDS",
    ]
    for words, below in tree(parser):
        if words and not commands(below):
            lines += [f".SS {program} {' '.join(words)}", ".B " + f"{program} {' '.join(words)}", _roff(_usage(below))]
            lines += [".PP", _roff(below.description or ""), *_options(below)]
            lines += [".PP", _roff(below.epilog)] if below.epilog else []
    lines += [".SH FILES", *_pairs(FILES), ".SH EXIT STATUS", *_pairs(EXITS[program])]
    others = ", ".join(f".BR {name} (1)" for name in PROGRAMS if name != program)
    return "\n".join([*lines, ".SH SEE ALSO", others, ".PP", _roff(parser.epilog or "")]) + "\n"


def _usage(parser: Parser) -> str:
    return parser.format_usage().split(maxsplit=1)[1].removeprefix(parser.prog).replace("\n", " ")


def _options(parser: Parser) -> list[str]:
    """A tagged paragraph for each but --help."""
    lines: list[str] = []
    for action in options(parser):
        if "--help" in action.option_strings:
            continue
        value = "" if action.nargs == 0 else _metavar(action)
        names = [f"\\fB{_roff(', '.join(action.option_strings))}\\fR"] if action.option_strings else []
        lines += [".TP", " ".join([*names, *([f"\\fI{_roff(value)}\\fR"] if value else [])])]
        lines.append(_roff(parser._get_formatter()._expand_help(action)) if action.help else "\\&")
    return lines


def _metavar(action: argparse.Action) -> str:
    shown = action.metavar or "|".join(str(choice) for choice in action.choices or ()) or action.dest.upper()
    return shown if isinstance(shown, str) else " ".join(shown)


def _pairs(table: dict[str, str]) -> list[str]:
    return [line for name, text in table.items() for line in (".TP", f"\\fB{_roff(name)}\\fR", _roff(text))]


def _roff(text: str) -> str:
    """Text that groff prints as it is."""
    plain = " ".join(text.split()).replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{plain}" if plain.startswith((".", "'")) else plain


# -- completion


def completion(program: str, parser: Parser) -> str:
    """A script for bash: commands, options, their choices, and file names where a file is asked for."""
    known = list(tree(parser))
    paths = "|".join(f"'{' '.join(words)}'" for words, _ in known if words)
    offered: list[str] = []
    values: dict[str, str] = {}
    for words, below in known:
        offers = [*commands(below), *(option for action in options(below) for option in action.option_strings)]
        files = "" if commands(below) else "; files=yes"
        offered.append(f"    '{' '.join(words)}') words='{' '.join(offers)}'{files} ;;")
        for action in options(below):
            if action.nargs != 0:
                values |= {" ".join((*words, option)): _value(action) for option in action.option_strings}
    asked = [f"    '{at}') {told}; return ;;" for at, told in sorted(values.items())]
    lines = (
        f"# bash completion for {program}",
        f"_{program}()",
        "{",
        "  local current=${COMP_WORDS[COMP_CWORD]} before=${COMP_WORDS[COMP_CWORD - 1]} path='' words='' files='' word",
        "  COMPREPLY=()",
        '  for word in "${COMP_WORDS[@]:1:COMP_CWORD-1}"; do',
        '    case "${path:+$path }$word" in',
        f"      {paths}) path=${{path:+$path }}$word ;;",
        "    esac",
        "  done",
        '  case "${path:+$path }$before" in',
        *asked,
        "  esac",
        "  case $path in",
        *offered,
        "  esac",
        '  mapfile -t COMPREPLY < <(compgen -W "$words" -- "$current"; [ -z "$files" ] || compgen -f -- "$current")',
        "}",
        f"complete -o filenames -F _{program} {program}",
    )
    return "\n".join(lines) + "\n"


def _value(action: argparse.Action) -> str:
    """The command that offers what an option takes."""
    if action.choices:
        choices = " ".join(str(choice) for choice in action.choices)
        return f"""mapfile -t COMPREPLY < <(compgen -W '{choices}' -- "$current")"""
    return 'mapfile -t COMPREPLY < <(compgen -f -- "$current")' if action.type is Path else ":"


def main(folder: Path) -> None:
    seconds = int(os.environ.get("SOURCE_DATE_EPOCH") or datetime.now(timezone.utc).timestamp())
    day = datetime.fromtimestamp(seconds, timezone.utc).date().isoformat()
    folder.mkdir(parents=True, exist_ok=True)
    for program, make in PROGRAMS.items():
        parser = make(())
        (folder / f"{program}.1").write_text(page(program, parser, day), encoding="utf-8")
        (folder / f"{program}.bash").write_text(completion(program, parser), encoding="utf-8")


if __name__ == "__main__":
    os.environ["COLUMNS"] = "100"  # usage is wrapped by the terminal's width
    main(Path(sys.argv[1]))
