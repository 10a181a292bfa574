"""Which place on the map, with lamps of known place besides ranges and marks.

While the place is sure and vision measures, lamps are held against it and change nothing. Within a gap those that are
where they are expected hold the pose. In doubt several that lie to each other as nowhere else say the place.
"""

from __future__ import annotations

import numpy as np

from ceilvo import se2
from ceilvo.calibration import Calibration
from ceilvo.config import Config
from ceilvo.daemon.odometry.dead_reckoning import DeadReckoningState, Track
from ceilvo.daemon.relocalisation.beacons.lamp_state import MISSING, LampState
from ceilvo.daemon.relocalisation.beacons.lamps import constellation
from ceilvo.daemon.relocalisation.beacons.lamps.seen import Held, LampView
from ceilvo.daemon.relocalisation.beacons.relocaliser import MARK_WRONG, BeaconRelocaliser
from ceilvo.daemon.relocalisation.beacons.trust import Trust
from ceilvo.senses.beacons import Lamp, LampSeen
from ceilvo.types import Array, Motion

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


class Lamps:
    """Beside a BeaconRelocaliser, which holds the state; where it knows of no lamps nothing is done."""

    def __init__(self, relocaliser: BeaconRelocaliser, calibration: Calibration, config: Config) -> None:
        self._relocaliser = relocaliser
        self._view = LampView(calibration, config.features.max_view_deg)
        self._false_place_rate = config.states.false_place_rate

    def followed(self, path: DeadReckoningState, track: Track, lamps: tuple[LampSeen, ...] | None) -> None:
        """After the relocaliser has followed: the lights of the picture there, None where none were looked for."""
        beacons = self._relocaliser.beacons
        if not beacons.marks.lamps:
            return
        s = beacons.lamps
        if track.final is not None and track.final.restarted:
            s.forget()
        s.way_m += 0.0 if s.odom is None else float(np.hypot(*(path.odom - s.odom)[:2]))
        s.odom = np.array(path.odom)
        if lamps is not None:
            known = tuple(lamp for lamp in beacons.marks.lamps if lamp.name not in s.trust.wrong)
            self._take(s, known, self._view.lights(lamps), track.gap)

    def _take(self, s: LampState, known: tuple[Lamp, ...], lights: Array, gap: Motion | None) -> None:
        changed, r = self._remember(s, lights), self._relocaliser
        if r.sure:
            pose, cov = r.bridge.pose if r.bridge.lives else r.filter.estimate()[:2]
            held = self._view.hold(known, lights, pose, cov)
            self._judge(s, known, held)
            for pair in held.pairs if r.bridge.lives else ():
                name = f"lamp {known[pair.lamp].name}"
                r.bridge.see_lamp(name, pair.off, pair.by_pose, pair.own_var, self._view.seen_var)
        elif changed:
            self._place(s, known, gap)

    @staticmethod
    def _judge(s: LampState, known: tuple[Lamp, ...], held: Held) -> None:
        """Which lamps are not where the file has them."""
        missed, trust = s.missed, Trust()
        trust.state = s.trust
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

    def _remember(self, s: LampState, lights: Array) -> bool:
        """Lights (N, 2) from the camera's foot, among those of the way; whether one counts that did not."""
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

    def _place(self, s: LampState, known: tuple[Lamp, ...], gap: Motion | None) -> None:
        """Several lights that lie as lamps do nowhere else say where the robot is."""
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
            names = ", ".join(sorted(known[k].name for k in found.lamps.tolist()))
            pose = np.asarray(se2.compose(found.map_from_odom, s.odom))
            self._relocaliser.begin_anew_at(pose, found.cov, f"lamps {names}", max(found.chance, MARK_WRONG), gap)
            s.chance = found.chance
