"""Which marks are believed: one that is not where the file says is noticed, named and ignored from then on."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.daemon.relocalisation.beacons.mark_poses import MarkPose
from ceilvo.se2 import wrap
from ceilvo.types import Array

GATE = 16.3
"""Squared distance of three degrees of freedom that one mark in a thousand which is where it should be exceeds."""
WRONG_M, WRONG_RAD = 0.05, float(np.radians(2.0))
"""A mark that is off by less is not called wrong: a tape measure errs as much; chosen."""
STRIKES = 5
"""Pictures that must contradict a mark more than bear it out; chosen: one may be a reflection."""


@dataclass(slots=True)
class TrustState:
    """By number of the mark as text.

    Attributes:
        strikes: pictures that contradicted it, less those that bore it out.
        wrong: why each is ignored.
        news: what was not told yet.
        pairs: marks that contradict each other.
    """

    strikes: dict[str, int] = field(default_factory=dict)
    wrong: dict[str, str] = field(default_factory=dict)
    news: list[str] = field(default_factory=list)
    pairs: list[str] = field(default_factory=list)


class Trust:
    """Holds marks against a pose that does not rest on them."""

    def __init__(self) -> None:
        self.state = TrustState()

    def believed(self, mark: MarkPose) -> bool:
        return str(mark.number) not in self.state.wrong

    def doubted(self, mark: MarkPose) -> bool:
        """Whether a picture contradicted it of late."""
        return self.state.strikes.get(str(mark.number), 0) > 0

    @staticmethod
    def fits(mark: MarkPose, pose: Array, cov: Array) -> bool:
        """Whether it says a pose (3,) with covariance (3, 3)."""
        off = _off(mark, pose)
        near = np.hypot(off[0], off[1]) < WRONG_M and abs(off[2]) < WRONG_RAD
        return bool(near or float(off @ np.linalg.solve(mark.cov + cov, off)) < GATE)

    def hold(self, mark: MarkPose, pose: Array, cov: Array) -> bool:
        """Compare with a pose (3,) with covariance (3, 3) that is sure; False where they contradict each other."""
        fits, off = self.fits(mark, pose, cov), _off(mark, pose)
        self.strike(str(mark.number), fits, f"{np.hypot(off[0], off[1]):.2f} m and {abs(np.degrees(off[2])):.0f} deg")
        return fits

    def after_search(self, number: int, surprised: bool) -> None:
        """The first view of the ceiling where a mark has put the robot: surprised when it contradicts the map."""
        if surprised:
            self.strike(str(number), False, "at another place")

    def contradict(self, mark: MarkPose, others: list[str]) -> None:
        """Marks that contradict each other where nothing else says who is right."""
        pair = " and ".join(sorted({str(mark.number), *others}))
        if pair not in self.state.pairs:
            self.state.pairs.append(pair)
            self.state.news.append(f"marks {pair} contradict each other; the ceiling will show which is wrong")

    def strike(self, name: str, fits: bool, how: str, what: str = "mark") -> None:
        """A picture that bears something out or contradicts it; how far it is off, and what it is, for people."""
        s = self.state
        s.strikes[name] = max(s.strikes.get(name, 0) - 1, 0) if fits else s.strikes.get(name, 0) + 1
        if s.strikes[name] >= STRIKES and name not in s.wrong:
            s.wrong[name] = how
            off = f"{what} {name} is {how} off where the file has it"
            s.news.append(f"{off}: ignored from now on; put it back, or correct the file")

    def take_news(self) -> list[str]:
        out, self.state.news = self.state.news, []
        return out


def _off(mark: MarkPose, pose: Array) -> Array:
    off = np.array(mark.pose - pose)
    off[2] = wrap(float(off[2]))
    return off
