"""`ceilvod experiment`: the benches that compare filters, called by name so that a robot never loads them."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module

EXPERIMENTS = {
    "paper": "the paper's section 3, simulated, against rivals",
    "mrclam": "recorded robots in the UTIAS multi-robot format",
    "speed": "time of a filter's step",
}


def run_experiment(name: str, arguments: Sequence[str]) -> int:
    """Exit code of an experiment of EXPERIMENTS."""
    if name == "paper":
        return int(import_module("ceilvo.bench.paper.__main__").main(arguments))
    if name == "mrclam":
        return int(import_module("ceilvo.bench.mrclam.__main__").main(arguments))
    return int(import_module("ceilvo.bench.speed.filter_step").main(arguments))
