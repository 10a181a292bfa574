"""All that ranges and marks leave behind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from ceilvo.daemon.odometry.dead_reckoning import DeadReckoningState, Track
from ceilvo.daemon.relocalisation.beacons.anchors import AnchorTable
from ceilvo.daemon.relocalisation.beacons.bridge import BridgeState
from ceilvo.daemon.relocalisation.beacons.lamp_state import LampState
from ceilvo.daemon.relocalisation.beacons.range_window import RangeWindow
from ceilvo.daemon.relocalisation.beacons.trust import TrustState
from ceilvo.senses.beacons import Beacons, LampSeen
from ceilvo.types import Array

FollowLamps = Callable[[DeadReckoningState, Track, "tuple[LampSeen, ...] | None"], None]
"""What is done with the lights of a picture, None where none were looked for (lamps/stage.py)."""


def no_lamps(path: DeadReckoningState, track: Track, lamps: tuple[LampSeen, ...] | None) -> None:
    """Nothing."""


@dataclass(slots=True)
class BeaconState:
    """
    Attributes:
        anchors: as they are known; marks: of the file, with its lamps.
        window: ranges since the doubt, or of late.
        odom, stamp_ns: of the last frame; odom (3,).
        fix_ns: when a fix was looked for last; located: places are searched for around one.
        shown, shown_ns: the mark that the last pictures showed, how often, and when last.
        settled: the mark that ended a search just now, -1 for none.
        heard, taken: ranges that came, and those to anchors that the file has.
    """

    anchors: AnchorTable = field(default_factory=AnchorTable)
    marks: Beacons = field(default_factory=Beacons)
    window: RangeWindow = field(default_factory=RangeWindow)
    odom: Array | None = None
    stamp_ns: int = 0
    fix_ns: int = 0
    located: bool = False
    wide: bool = False
    shown: int = -1
    shown_times: int = 0
    shown_ns: int = 0
    settled: int = -1
    heard: int = 0
    taken: int = 0
    trust: TrustState = field(default_factory=TrustState)
    bridge: BridgeState = field(default_factory=BridgeState)
    lamps: LampState = field(default_factory=LampState)
