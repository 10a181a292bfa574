"""Repeats of slow tests: `make test-long` runs them too. `make test` has those that tell most."""

from __future__ import annotations

import os

import pytest

LONG = pytest.mark.skipif(os.environ.get("LONG") != "all", reason="long: make test-long")


def long(*values: object) -> object:
    """Parameters of a test that only `make test-long` runs."""
    return pytest.param(*values, marks=LONG)
