"""Page's CUSUM: evidence adds up, and is forgotten while it speaks against the suspicion."""

from __future__ import annotations

import math
from dataclasses import dataclass


def threshold(samples_between_false_alarms: float) -> float:
    """Limit of a sum of log-likelihood ratios that independent samples without a cause reach so seldom, or more seldom.

    The mean number of samples before a false alarm is at least exp(limit) (Lorden 1971, Ann. Math. Stat. 42, 1897).
    """
    return math.log(samples_between_false_alarms)


@dataclass(slots=True)
class Cusum:
    """Sum of log-likelihood ratios, never below 0; `alarm` holds until the sum of the opposite ones gets as far."""

    total: float = 0.0
    alarm: bool = False

    def add(self, log_ratio: float, limit: float) -> None:
        """Take in one sample's log(likelihood with the cause / without)."""
        if self.reaches(-log_ratio if self.alarm else log_ratio, limit):
            self.alarm = not self.alarm

    def reaches(self, log_ratio: float, limit: float) -> bool:
        """Take in one sample; whether that takes the sum to its limit, after which it begins anew."""
        self.total = max(0.0, self.total + log_ratio)
        if self.total < limit:
            return False
        self.total = 0.0
        return True


def log_normal(x: float, mean: float, sigma: float) -> float:
    """Log density of a normal distribution."""
    return -0.5 * ((x - mean) / sigma) ** 2 - math.log(sigma * math.sqrt(2.0 * math.pi))
