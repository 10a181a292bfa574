"""Who looks on while a step works: on the command line nobody does, in the browser's wizard an engineer who steers."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ceilvo.calib.targets.sources import Picture, SourceInfo

if TYPE_CHECKING:
    from ceilvo.calib.targets.marks import Click

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Look:
    """What a step made of one picture.

    Attributes:
        part: whose samples it belongs to, as Session.samples names them.
        reason: why it does not count, "" where it does.
        taken: whether it is one of the accepted ones now.
        uv_px: (N, 2) what was found in it.
        views: all accepted ones in order, (name, rms_px or None where it is not known yet).
        facts: of the step's own, such as coverage.
        hint: what to do next, "" where nothing is missing.
    """

    part: str
    picture: Picture
    reason: str
    taken: bool
    uv_px: Array
    views: Sequence[tuple[str, float | None]]
    facts: Mapping[str, Any]
    hint: str


class Watch:
    """Nobody: sees nothing, asks for nothing."""

    present = False
    """Whether it is worth while to tell it what costs time."""
    no_more = ""
    """The name of the source whose samples are enough: nothing more is taken, the step only computes."""

    def opened(self, info: SourceInfo) -> None:
        """Pictures begin to come."""

    def looked(self, look: Look) -> None:
        """After each picture; may raise to end the step, whose samples are kept."""

    def dropped(self, part: str) -> list[int]:
        """Places in the list of accepted views that are to be taken out now, one after the other."""
        return []

    @property
    def ended(self) -> bool:
        """Whether what was taken is declared to be enough."""
        return False

    def told(self, text: str) -> None:
        """A line about what goes on."""

    def concluded(self, step: str, rows: Sequence[tuple[str, str]], problems: Sequence[str]) -> None:
        """The step's figures and verdict."""

    def click(self) -> Click | None:
        """How marks are clicked; None = on a page of its own."""
        return None


_NOBODY = Watch()


def watch_of(args: argparse.Namespace) -> Watch:
    found = getattr(args, "watch", _NOBODY)
    assert isinstance(found, Watch)
    return found
