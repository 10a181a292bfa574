"""What the daemon is told of a frame besides the picture."""

from __future__ import annotations

from dataclasses import dataclass

from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.types import WheelMotion


@dataclass
class Said:
    """Each sense adds its own."""

    wheels: WheelMotion | None = None
    heard: Heard = NOTHING
