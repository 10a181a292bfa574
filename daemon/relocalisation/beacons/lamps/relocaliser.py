"""Which place on the map, with lamps of known place besides ranges and marks.

While the place is sure and vision measures, lamps are held against it and change nothing. Within a gap those that are
where they are expected hold the pose. In doubt several that lie to each other as nowhere else say the place.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.odometry.dead_reckoning import DeadReckoningState, Track
from ceilvo.daemon.relocalisation.beacons.lamps import constellation
from ceilvo.daemon.relocalisation.beacons.lamps.constellation import Constellation
from ceilvo.daemon.relocalisation.beacons.lamps.seen import Held, LampView
from ceilvo.daemon.relocalisation.beacons.lamps.state import SPOT_COLUMNS, LampState
from ceilvo.daemon.relocalisation.beacons.relocaliser import MARK_WRONG, BeaconRelocaliser
from ceilvo.daemon.relocalisation.beacons.state import BeaconState
from ceilvo.daemon.relocalisation.beacons.trust import Trust
from ceilvo.daemon.relocalisation.doubts import UNLIKELY, Doubt
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.senses.beacons import Lamp, LampSeen
from ceilvo.senses.heard import Heard
from ceilvo.types import Array, Landmarks, Motion

MISSING = 20
"""Pictures in a row without a light where a lamp should be, after which that is said; chosen: two seconds or more."""
SAME_M = 0.35
"""Lights of two pictures that lie so near to each other are one; chosen: one that hangs lower seems to move."""
PICTURES = 2
"""That must show a light before it counts: one may be a reflection; chosen."""
KEPT_M = 20.0
"""Way after which a light is forgotten; chosen: on good wheels that is off by a tile's width."""
MOST_SPOTS = 12
"""Lights that are kept, the latest; chosen for time."""
MOST_CHANCE = 0.02
"""That lights lie so by chance, up to which the robot is put there; chosen."""
_TIMES, _FOOT, _ARM, _AT = 0, slice(1, 3), slice(3, 5), 5


class LampRelocaliser(BeaconRelocaliser):
    """A BeaconRelocaliser that is told of lamps, or of none: then it is that one."""

    def __init__(self, filter_: PoseFilter, calibration: Calibration, config: Config) -> None:
        super().__init__(filter_, calibration, config)
        self._view, self._lamp_trust = LampView(calibration, config.features.max_view_deg), Trust()
        self._false_place_rate = config.states.false_place_rate

    @property
    def _lamps(self) -> LampState:
        return self._beacons.lamps

    @property
    def beacons(self) -> BeaconState:
        self._beacons.lamps.trust = self._lamp_trust.state
        return super().beacons

    @beacons.setter
    def beacons(self, state: BeaconState) -> None:
        BeaconRelocaliser.beacons.__set__(self, state)  # type: ignore[attr-defined]
        self._lamp_trust.state = state.lamps.trust

    def beacons_learnt(self) -> Mapping[str, object]:
        out = dict(super().beacons_learnt())
        if self._beacons.marks.lamps:
            out["lamps"] = {"ignored": sorted(self._lamp_trust.state.wrong), "missing": self._missing()}
        return out

    def _missing(self) -> list[str]:
        return sorted(name for name, times in self._lamps.missed.items() if times >= MISSING)

    def take_news(self) -> list[str]:
        return super().take_news() + self._lamp_trust.take_news()

    def start_at(self, pose: Array, cov: Array, landmarks: Landmarks | None, doubt: Doubt | None = None) -> None:
        super().start_at(pose, cov, landmarks, doubt)
        self._forget()

    def raise_doubt(self, doubt: Doubt) -> None:
        super().raise_doubt(doubt)
        if self.state.pending is not None and doubt.elsewhere >= UNLIKELY:
            self._forget()

    def _forget(self) -> None:
        s = self._lamps
        s.spots, s.odom, s.chance = np.zeros((0, SPOT_COLUMNS)), None, 1.0

    def followed(self, path: DeadReckoningState, track: Track, crossings: int, heard: Heard) -> None:
        super().followed(path, track, crossings, heard)
        if not self._beacons.marks.lamps:
            return
        s = self._lamps
        if track.final is not None and track.final.restarted:
            self._forget()
        s.way_m += 0.0 if s.odom is None else float(np.hypot(*(path.odom - s.odom)[:2]))
        s.odom = np.array(path.odom)
        if heard.lamps is not None:
            self._take_lamps(heard.lamps, track.gap)

    def _take_lamps(self, seen: tuple[LampSeen, ...], gap: Motion | None) -> None:
        lights = self._view.lights(seen)
        changed = self._remember(lights)
        known = tuple(lamp for lamp in self._beacons.marks.lamps if lamp.name not in self._lamp_trust.state.wrong)
        if self.sure:
            in_gap = self._bridge.lives
            pose, cov = self._bridge.pose if in_gap else self.filter.estimate()[:2]
            held = self._view.hold(known, lights, pose, cov)
            self._judge(known, held)
            for pair in held.pairs if in_gap else ():
                self._bridge.see_of(f"lamp {known[pair.lamp].name}", pair.by_pose, pair.off, pair.cov)
        elif changed:
            self._place(known, gap)

    def _judge(self, known: tuple[Lamp, ...], held: Held) -> None:
        """Which lamps are not where the file has them."""
        missed, trust = self._lamps.missed, self._lamp_trust
        for pair in held.pairs:
            name = known[pair.lamp].name
            missed.pop(name, None)
            trust.strike(name, True, "", "lamp")
        for row, off_m in held.moved:
            trust.strike(known[row].name, False, f"{off_m:.2f} m", "lamp")
        for row in held.missing:
            name = known[row].name
            missed[name] = missed.get(name, 0) + 1
            if missed[name] == MISSING:
                where = f"lamp {name} is not seen where the file has it"
                trust.state.news.append(f"{where}: switch it on, put it back, or correct the file")

    # -- in doubt

    def _remember(self, lights: Array) -> bool:
        """Lights (N, 2) from the camera's foot, among those of the way; whether one counts that did not."""
        s = self._lamps
        assert s.odom is not None
        turn = se2.rotation(float(s.odom[2]))
        foot, changed = s.odom[:2] + turn @ self._view.foot_m, False
        s.spots = s.spots[s.spots[:, _AT] > s.way_m - KEPT_M]
        for arm in lights @ turn.T:
            off = np.hypot(*(s.spots[:, _FOOT] + s.spots[:, _ARM] - foot - arm).T)
            if not len(off) or np.min(off) > SAME_M:
                s.spots = np.vstack([s.spots, [1.0, *foot, *arm, s.way_m]])[-MOST_SPOTS:]
                continue
            row = s.spots[int(np.argmin(off))]
            times = row[_TIMES] + 1.0
            row[_FOOT] += (foot - row[_FOOT]) / times
            row[_ARM] += (arm - row[_ARM]) / times
            row[_TIMES], row[_AT] = times, s.way_m
            changed |= times == PICTURES
        return changed

    def _place(self, known: tuple[Lamp, ...], gap: Motion | None) -> None:
        """Several lights that lie as lamps do nowhere else say where the robot is."""
        s = self._lamps
        assert s.odom is not None
        lights = s.spots[s.spots[:, _TIMES] >= PICTURES]
        lamps = np.array([[lamp.x_m, lamp.y_m] for lamp in known]).reshape(-1, 2)
        nearer = np.array([self._view.nearer(lamp) for lamp in known])
        own_m = max((lamp.sigma_m for lamp in known), default=0.0)
        sigma_m = float(np.hypot(self._view.seen_sigma_m, own_m))
        found = constellation.find(lights[:, 1:5], lamps, nearer, sigma_m, s.odom)
        if found is None or found.chance >= min(s.chance, MOST_CHANCE):
            return
        if gap is None or found.chance < self._false_place_rate:
            s.chance = found.chance
            self._settle(found, known, gap)

    def _settle(self, found: Constellation, known: tuple[Lamp, ...], gap: Motion | None) -> None:
        odom = self._lamps.odom
        assert odom is not None
        names = ", ".join(sorted(known[k].name for k in found.lamps.tolist()))
        pose = np.asarray(se2.compose(found.map_from_odom, odom))
        self._begin_anew_at(pose, found.cov, f"lamps {names}", max(found.chance, MARK_WRONG), gap)
