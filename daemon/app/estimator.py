"""The pipeline in a running process: one lock, stage times, commands from outside."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from types import MappingProxyType

import numpy as np

from ceilvo.calibration import LEVEL_CEILING, CeilingShape
from ceilvo.daemon.integrity.stamp_rate import StampRate
from ceilvo.daemon.map.key_poses import KeyPoses
from ceilvo.daemon.map.map_file import StoredMap, StoredState
from ceilvo.daemon.odometry.senses.learnt import learnt
from ceilvo.daemon.pipeline import Pipeline
from ceilvo.daemon.refinement.key_pose_taker import KeyPoseTaker
from ceilvo.daemon.relocalisation.doubts import JUST_NOW_S
from ceilvo.daemon.relocalisation.floors import Floors
from ceilvo.daemon.replay.inputs import FrameInput, Input, KnownBeacons, LoadMap, Reset, SetPose, Silence, apply
from ceilvo.daemon.vision.finder.crossing_finder import OnStageDone, View, ignore
from ceilvo.errors import CeilvoError
from ceilvo.senses.beacons import Beacons
from ceilvo.senses.heard import NOTHING, Heard
from ceilvo.types import Array, Estimate, Frame, Landmarks, Pose, WheelMotion

Clock = Callable[[], int]
Wheels = Callable[[int, int], WheelMotion | None]
Hears = Callable[[int, int], Heard]
Finds = Callable[[Frame, bool, Heard], Heard]
InputListener = Callable[[Input, Estimate | None, Pipeline], None]
"""Gets every input in its order, with what came of it; called under the lock, so it must be quick and not raise."""

_RESTART_SIGMA = np.array([0.05, 0.05, 0.05])
"""m, m, rad, added to a stored pose; chosen: a robot that is switched off may be nudged."""
_SEARCH_SIGMA = np.array([0.3, 0.3, 0.1])
"""m, m, rad, of a search that was asked for; chosen: half a tile, and far less than the 45 deg of another quarter."""
MOST_KEY_POSES = 500
"""That wait to be kept; chosen: 125 m of driving on a disk that refuses."""
_LAG_DECAY = 0.9
"""Per frame, of the delay of frames; chosen: the slowest of the last ten or so counts."""
_MAX_LAG_NS = 1_000_000_000
"""A frame that came later than this is not typical; chosen: it has stood in a queue."""


def no_wheels(stamp0_ns: int, stamp1_ns: int) -> WheelMotion | None:
    """For robots whose base does not report odometry."""
    return None


def hears_nothing(stamp0_ns: int, stamp1_ns: int) -> Heard:
    """For robots with no other senses than camera and wheels."""
    return NOTHING


def finds_nothing(frame: Frame, sure: bool, heard: Heard) -> Heard:
    """For ceilings without marks."""
    return heard


@dataclass(frozen=True, slots=True)
class Display:
    """What pictures and maps are made from; nothing in it changes any more."""

    view: View | None
    particles: Array
    weights: Array
    landmarks: Landmarks


@dataclass(frozen=True, slots=True)
class Moved:
    """What a pipeline was on before it went on on another map, and its last estimate there."""

    map: StoredMap
    last: Estimate


def no_listener(given: Input, estimate: Estimate | None, pipeline: Pipeline) -> None:
    """For runs that nobody records."""


class Estimator:
    """Thread-safe. Frames come from one thread, commands and questions from any."""

    def __init__(
        self,
        pipeline: Pipeline,
        clock: Clock,
        wheels: Wheels = no_wheels,
        listener: InputListener = no_listener,
        session: str | None = None,
        hears: Hears = hears_nothing,
        finds: Finds = finds_nothing,
    ) -> None:
        """session: names the drive that key poses are of; None: none are taken."""
        self._pipeline = pipeline
        self._taker = None if session is None else KeyPoseTaker(session, MOST_KEY_POSES)
        self._clock = clock
        self._wheels, self._hears, self._finds = wheels, hears, finds
        self._listener = listener
        self._lock = threading.Lock()
        self._last: Estimate | None = None
        self._times_said: dict[str, int] = {}
        self._late = 0
        self._lag_ns = 0
        self._stamps = StampRate()

    @property
    def last(self) -> Estimate | None:
        return self._last

    @property
    def late(self) -> int:
        """Frames that came after a later moment had been estimated, and were dropped."""
        return self._late

    @property
    def stamp_fault(self) -> str:
        """Why frames are stamped with their time of arrival, "" while they are not."""
        return self._stamps.state.reason

    def frame(self, frame: Frame, live: bool = True) -> Estimate | None:
        """The estimate at a frame, None when the frame is older than the last estimate.

        Args:
            live: it comes now, so its stamp can be held against the clock.
        """
        start_ns = mark_ns = self._clock()
        if live:
            frame = replace(frame, stamp_ns=self._stamps.usable(frame.stamp_ns, start_ns))
        age_ns = start_ns - frame.stamp_ns
        stage_times_ms: dict[str, float] = {"queue": 1e-6 * age_ns}

        def on_stage_done(stage: str) -> None:
            nonlocal mark_ns
            now_ns = self._clock()
            stage_times_ms[stage] = 1e-6 * (now_ns - mark_ns)
            mark_ns = now_ns

        with self._lock:
            self._lag_ns = min(max(age_ns, round(_LAG_DECAY * self._lag_ns)), _MAX_LAG_NS)
            before_ns = self._pipeline.dead_reckoning.state.stamp_ns
            if before_ns is not None and frame.stamp_ns <= before_ns:
                self._late += 1
                return None
            wheels = None if before_ns is None else self._wheels(before_ns, frame.stamp_ns)
            heard = NOTHING if before_ns is None else self._hears(before_ns, frame.stamp_ns)
            heard = self._finds(frame, self._pipeline.relocaliser.sure, heard)
            estimate = self._do(FrameInput(frame, wheels, heard), on_stage_done)
        if estimate is None:
            return None
        stage_times_ms["step"] = 1e-6 * (self._clock() - start_ns)
        self._last = replace(estimate, latency_ms=MappingProxyType(stage_times_ms))
        return self._last

    def silence(self, reason: str) -> Estimate | None:
        """An estimate without a frame, for a camera that went silent; None before the first frame.

        It is of the moment that a frame arriving now would be of: later, and every frame of a camera that is slower
        than the interval between two calls would be late.
        """
        with self._lock:
            before_ns = self._pipeline.dead_reckoning.state.stamp_ns
            if before_ns is None:
                return None
            now_ns = max(self._clock() - self._lag_ns, before_ns + 1)
            heard = self._hears(before_ns, now_ns)
            self._last = self._do(Silence(now_ns, reason, self._wheels(before_ns, now_ns), heard))
            return self._last

    def load_map(self, stored_map: StoredMap, state: StoredState | None, floors: Floors | None = None) -> None:
        """Begin on the map of an earlier run; its last pose is a hypothesis. Without one the robot may be anywhere.

        Args:
            floors: of the map; the pose, too, is in their common frame then.
        """
        with self._lock:
            pose = Pose(np.zeros(3)) if state is None else state.pose
            cov = np.diag(_RESTART_SIGMA**2) + (0.0 if state is None else state.cov)
            ago_ns = self._clock() - (0 if state is None else state.stamp_ns)
            ago_s = 1e-9 * ago_ns if state is not None and ago_ns >= 0 else math.inf  # clocks begin anew at boot
            elsewhere, ceiling = (0.0, LEVEL_CEILING) if state is None else (state.elsewhere, state.ceiling)
            knows = stored_map.landmarks, stored_map.map_axis_rad
            self._do(LoadMap(*knows, pose, cov, ago_s, elsewhere, floors or Floors(), ceiling))
            if state is None:
                self._do(Reset(keep_map=True))

    def move_to(self, moved: Callable[[StoredMap, Array], tuple[StoredMap, Pose]], sigma: Array) -> Moved | None:
        """Go on on another map; where the robot is on it is to be confirmed by landmarks. None before the first map,
        and where it has several floors, which lie in a frame of their own.

        Args:
            moved: gives that map and the pose (3,) there, for the map in use and the pose on it.
            sigma: (3,) standard deviations of how well it knows that.
        """
        with self._lock:
            last, axis_rad = self._last, self._pipeline.relocaliser.state.map_axis_rad
            if last is None or axis_rad is None or self._floors.floors:
                return None
            before = StoredMap(self._pipeline.landmarks(), axis_rad)
            after, pose = moved(before, last.pose)
            cov = last.cov + np.diag(np.square(sigma))
            elsewhere, ceiling = self._pipeline.elsewhere, self._pipeline.odometry.ceiling(pose)
            knows = after.landmarks, after.map_axis_rad
            self._do(LoadMap(*knows, pose, cov, JUST_NOW_S, elsewhere, ceiling=ceiling))
            return Moved(before, last)

    def set_pose(self, pose: Pose, sigma: Array, why: str, floor: str = "") -> None:
        """Continue from a pose given from outside, (3,) map_from_base with standard deviations (3,).

        Args:
            floor: that it is on; "" for the one that the robot is on.

        Raises:
            CeilvoError: there is no such floor.
        """
        with self._lock:
            known = [f.name for f in self._floors.floors]
            if floor and known and floor not in known:
                names = ", ".join(map(repr, known))
                raise CeilvoError(f"map_id: found {floor!r}, expected a floor of the map that is loaded: {names}")
            self._do(SetPose(pose, np.diag(np.square(sigma)), why, floor))

    def relocalise(self) -> Array:
        """Spread the particles around the last pose and let landmarks confirm it; returns the (3,) sigma used."""
        with self._lock:
            pose, floor = (Pose(np.zeros(3)), "") if self._last is None else (self._last.pose, self._last.floor)
            self._do(SetPose(pose, np.diag(_SEARCH_SIGMA**2), "relocalisation asked for", floor))
        return _SEARCH_SIGMA

    def reset(self, keep_map: bool) -> None:
        """Start again at the configured pose, with the map or without."""
        with self._lock:
            self._do(Reset(keep_map))

    def _do(self, given: Input, on_stage_done: OnStageDone = ignore) -> Estimate | None:
        """The one way to change the pipeline, so that a recording has all that a replay needs; under the lock."""
        estimate = apply(self._pipeline, given, on_stage_done)
        self._listener(given, estimate, self._pipeline)
        if self._taker is None:
            return estimate
        if estimate is not None:
            self._taker.add(self._pipeline, estimate, self._pipeline.seen)
        elif isinstance(given, LoadMap) or (isinstance(given, Reset) and not given.keep_map):
            self._taker.restart()
        return estimate

    def display(self) -> Display:
        with self._lock:
            particles, weights = self._pipeline.filter.particles()
            floors, floor, view = self._floors, self._floor, self._pipeline.vision.view
            landmarks = floors.landmarks_on(floor, self._pipeline.filter.landmarks())
            return Display(view, floors.poses_on(floor, particles), weights, landmarks)

    def counters(self) -> Mapping[str, int]:
        """Of the filter, see slam.pose_filter.COUNTERS."""
        with self._lock:
            return self._pipeline.filter.counters()

    def refused(self) -> int:
        """Landmarks that the map did not take so far: not seen again, or no room."""
        counters = self.counters()
        return counters["refused"] + counters["map_full"]

    def suspicions(self) -> Mapping[str, int]:
        """How often picture, wheels and stamps were against each other, by kind."""
        with self._lock:
            place = self._pipeline.relocaliser.times_said
            return self._pipeline.checks.counters | {"stamp_rate": self._stamps.state.faults} | place

    def place_search(self) -> Mapping[str, object] | None:
        """What the last look through the whole map gave, see PlaceSearch; None where none was needed."""
        with self._lock:
            found = self._pipeline.relocaliser.state.search
            return None if found is None else asdict(found)

    def noticed(self) -> tuple[tuple[str, str], ...]:
        """Name and reason of what senses noticed in the last frame for the first time."""
        place = self._pipeline.relocaliser
        marks = tuple(("mark", text) for text in place.take_news())
        before, self._times_said = self._times_said, place.times_said
        off = tuple((name, place.doubt) for name, n in self._times_said.items() if n > before.get(name, 0))
        return tuple((s.kind.value, s.reason) for s in self._pipeline.checks.begun) + marks + off

    def know(self, beacons: Beacons) -> None:
        """Of these anchors and marks, if there are any."""
        if beacons != Beacons():
            with self._lock:
                self._do(KnownBeacons(beacons))

    def senses(self) -> Mapping[str, object]:
        """What was learnt of wheels, gyro and delays; nothing where none of it is switched on."""
        with self._lock:
            motion = learnt(self._pipeline.checks.senses, self._pipeline.config.senses)
            return {**motion, **self._pipeline.relocaliser.beacons_learnt()}

    def map(self) -> tuple[Landmarks, float | None]:
        """Of all floors, in their common frame."""
        with self._lock:
            return self._pipeline.landmarks(), self._pipeline.relocaliser.state.map_axis_rad

    def map_on(self, floor: str) -> tuple[Landmarks, float | None]:
        """The map of one floor, in its own frame; where there is only one, that one."""
        with self._lock:
            floors, axis_rad = self._floors, self._pipeline.relocaliser.state.map_axis_rad
            here = floors.landmarks_on(floor, self._pipeline.landmarks())
            return here, None if axis_rad is None else floors.axis_on(floor, axis_rad)

    def floors(self) -> tuple[str, ...]:
        """Of the map; none where it has only one."""
        with self._lock:
            return tuple(f.name for f in self._floors.floors)

    @property
    def floor(self) -> str:
        """That the robot is on; "" where there is only one."""
        with self._lock:
            return self._floor

    @property
    def _floors(self) -> Floors:
        return self._pipeline.relocaliser.floor_tracker.floors

    @property
    def _floor(self) -> str:
        return self._pipeline.relocaliser.floor_tracker.name_at(self._pipeline.filter.estimate()[0])

    def key_poses(self, floor: str = "") -> KeyPoses | None:
        """Those of a floor that were taken since they were last kept; None where none are."""
        with self._lock:
            return None if self._taker is None else self._taker.taken(floor)

    def key_poses_kept(self, key_poses: KeyPoses | None) -> None:
        """These are on the disk now."""
        with self._lock:
            if self._taker is not None and key_poses is not None:
                self._taker.kept(key_poses)

    def elsewhere(self) -> float:
        """Probability that the robot is at another place than the last estimate says."""
        with self._lock:
            return self._pipeline.elsewhere

    def ceiling(self) -> CeilingShape:
        """What was found out of the ceiling's shape."""
        with self._lock:
            return self._pipeline.odometry.ceiling(self._pipeline.filter.estimate()[0])
