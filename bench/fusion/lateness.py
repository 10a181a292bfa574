"""By how much a camera is late, picture by picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Lateness:
    """
    Attributes:
        mean_s: of all pictures; jitter_s: each one's own, evenly by so much more or less.
        then_s: mean from then_at_s on.
    """

    mean_s: float = 0.0
    jitter_s: float = 0.0
    then_s: float = 0.0
    then_at_s: float = np.inf

    @property
    def most_s(self) -> float:
        return max(self.mean_s, self.then_s) + self.jitter_s

    def of(self, time_s: float, rng: np.random.Generator) -> float:
        """Of a picture that is taken then, s."""
        mean_s = self.mean_s if time_s < self.then_at_s else self.then_s
        return mean_s + self.jitter_s * float(rng.uniform(-1.0, 1.0))


NONE = Lateness()
"""Of a camera that is never late."""
