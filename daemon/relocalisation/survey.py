"""What must be known of a map to find a place on it: its ground, its index, and how often chance explains a feature."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ceilvo.crossing_types import JOINTS, commonest
from ceilvo.daemon.odometry.sight import CROWD_M, crowd
from ceilvo.daemon.relocalisation.evidence.chance import Chance
from ceilvo.daemon.relocalisation.evidence.coverage import Coverage
from ceilvo.daemon.relocalisation.evidence.view_evidence import Surroundings, ViewEvidence
from ceilvo.daemon.relocalisation.evidence.wrong_places import combined
from ceilvo.daemon.relocalisation.lattice import WATCH_M, Lattice, repeats, rival_from_tracked, same_places
from ceilvo.daemon.relocalisation.not_this_map import Weigh
from ceilvo.daemon.relocalisation.place_index.place_index import PlaceIndex
from ceilvo.daemon.relocalisation.submap import rest_of
from ceilvo.daemon.slam.pose_filter import PoseFilter
from ceilvo.se2 import transform
from ceilvo.types import Array, Ints, Landmarks, Observations, Pose

MEASURED_M = 6.0
"""How often chance explains a feature is measured on the map so far around the robot; chosen."""
MEASURE_AGAIN_M = 1.0
"""And again after so much of the way."""
FEWEST_MEASURED, FURTHEST_M = 60, 48.0
"""Landmarks but for the commonest type that it takes; where there are fewer, the map twice, four and eight times as far
around is asked, as a robot that drives on over new ground leaves it; chosen: the corners of fifteen lamps."""
INDEXED_M, EDGE_M = 2.5, 0.1
"""What a view may change of the map lies so near the robot, or as far as the camera sees; most see less. At the
edge of that a landmark may have come in since the index took it up."""

MISPLACED_M = 0.06
"""A landmark so near a misplaced crossing is of it; chosen: it moved on while its height was not known."""


@dataclass(slots=True)
class MapSurvey:
    """Grows with the filter's map.

    Attributes:
        coverage: ground that the map knows.
        index: of the whole map.
        chance: how often a wrong place explains a feature, None before it was measured.
        measured_m: way since it was.
        few: it was measured on so few landmarks that how alike the ceiling is, is a guess.
        watched_m: how far off rivals of a sure place are at most.
    """

    coverage: Coverage = field(default_factory=Coverage.of_kinds)
    index: PlaceIndex = field(default_factory=PlaceIndex)
    chance: Chance | None = None
    measured_m: float = np.inf
    watched_m: float = WATCH_M
    few: bool = False

    @staticmethod
    def of(landmarks: Landmarks, axis_rad: float) -> MapSurvey:
        """Of a map that came without."""
        lattice = Lattice.of(landmarks, axis_rad)
        tile_m = 0.0 if lattice is None else float(np.max(lattice.tile_m))
        return MapSurvey(Coverage.of(landmarks, tile_m), PlaceIndex.of(landmarks))

    def around(
        self,
        filter_: PoseFilter,
        view: Observations,
        pose: Array,
        reach_m: float,
        axis_rad: float,
        submap_from: int | None = None,
    ) -> Surroundings:
        """The part of the map that a view is weighed on at poses within reach of a pose (3,) at least, no submap."""
        seen_m = float(np.max(np.hypot(*view.xy_base_m.T), initial=0.0)) + 1.0
        radius_m = max(MEASURED_M, reach_m + seen_m)
        near, reach_m = filter_.landmarks_near(pose[None, :2], radius_m)[1], radius_m - seen_m
        near = rest_of(near, submap_from)
        chance = Chance.unmeasured(near) if self.chance is None else self.chance
        named = self.index.named(near.ids)
        out = Surroundings.of(near, self.coverage, chance, reach_m, axis_rad, named)
        if self.measured_m < MEASURE_AGAIN_M:
            return out
        self.chance, self.measured_m = self._measured(filter_, pose, axis_rad, submap_from, out), 0.0
        return Surroundings.of(near, self.coverage, self.chance, reach_m, axis_rad, named)

    def _measured(
        self, filter_: PoseFilter, pose: Array, axis_rad: float, submap_from: int | None, out: Surroundings
    ) -> Chance:
        """How often chance explains a feature, on as much of the map around a pose (3,) as it takes."""
        around_m = MEASURED_M
        while _rare(out.landmarks) < FEWEST_MEASURED and around_m < FURTHEST_M:
            around_m *= 2.0
            wider = rest_of(filter_.landmarks_near(pose[None, :2], around_m)[1], submap_from)
            if len(wider) > len(out.landmarks):
                own = self.index.named(wider.ids)
                out = Surroundings.of(wider, self.coverage, out.chance, out.reach_m, axis_rad, own)
        self.few = _rare(out.landmarks) < FEWEST_MEASURED
        named = out.landmarks.of(self.index.named(out.landmarks.ids))
        lattice = Lattice.of(out.landmarks, axis_rad)
        if lattice is not None and lattice.crossing_type == JOINTS:
            about_m = lattice.joint_near(pose[:2])
            return Chance.measured(named, out.raster, self.coverage, lattice.shifts(MEASURED_M), about_m=about_m)
        return Chance.measured(named, out.raster, self.coverage, repeats(named, MEASURED_M), any_name=True)

    def watched(self, around: Surroundings, pose: Array, view: Observations) -> Array:
        """(M, 3) rival_from_tracked of where a robot at a sure pose (3,) may have got to without a trace."""
        lattice = Lattice.of(around.landmarks, around.axis_rad)
        if lattice is None:
            return np.zeros((0, 3))
        self.watched_m = lattice.watched_m + float(np.max(lattice.tile_m))  # turned ones are put onto the lattice
        return lattice.rivals(pose, view, lattice.watched_m, turned=True)

    def log_ratio(self, evidence: ViewEvidence, poses: Array, pose: Array) -> Array:
        """(P, 2) log-likelihood ratios of poses (P, 3); far off the tracked one (3,) by the index."""
        far = np.hypot(*(poses - pose)[:, :2].T) > evidence.reach_m
        out = np.empty((len(poses), 2))
        out[~far] = evidence.log_ratio(poses[~far])
        if np.any(far):
            out[far] = evidence.log_ratio_in(self.index.grid, poses[far])
        return out

    def weigher(self, around: Surroundings) -> Weigh:
        """Weighs views at places anywhere on the map."""

        def weigh(view: Observations, worth: float, poses: Array) -> tuple[Array, Array]:
            evidence = ViewEvidence(view, around, np.full(len(view), worth))
            return evidence.log_ratio_in(self.index.grid, poses), evidence.known(poses)

        return weigh

    def learnt(self, filter_: PoseFilter, visible_m: Array, kind: Ints) -> None:
        """The filter has learnt from a view of features of types (K,), that showed all there is in a polygon (V, 2) in
        base, (0, 2) for none."""
        pose = Pose(filter_.estimate()[0])
        if len(visible_m):
            self.coverage.show(transform(pose, visible_m), kind)
        reach_m = max(INDEXED_M, float(np.max(np.hypot(*visible_m.T), initial=0.0)))
        near = filter_.landmarks_near(pose[None, :2], reach_m)[1]
        self.index.sync(near)
        there = self.index.within(pose[:2] - reach_m + EDGE_M, pose[:2] + reach_m - EDGE_M)
        self.index.remove(np.setdiff1d(there, near.ids))

    def forget_near(self, filter_: PoseFilter, xy_base_m: Array, visible_m: Array) -> None:
        """Filter and index drop landmarks at points (N, 2) in base: what was learnt there is elsewhere.

        Landmarks that are not shown yet may be of them, and are begun again. The ground that is in view, a polygon
        (V, 2) in base, was shown without what lies there.
        """
        pose = Pose(filter_.estimate()[0])
        self.coverage.forget(transform(pose, visible_m))
        at = transform(pose, xy_base_m)
        near = filter_.landmarks_near(at, MISPLACED_M)[1]
        off = near.xy_map_m[:, None] - at
        wrong = near.ids[np.any(np.hypot(off[..., 0], off[..., 1]) < MISPLACED_M, axis=1)]
        filter_.forget(wrong, newborn=True)
        self.index.remove(wrong)


def _rare(landmarks: Landmarks) -> float:
    """How many are not of the commonest type, those at one corner as one: a lamp's field and frame both have it."""
    if not len(landmarks):
        return 0.0
    rare = landmarks.crossing_type != commonest(landmarks.crossing_type)
    return float(np.sum(1.0 / crowd(landmarks.xy_map_m[rare], CROWD_M)))


def aligned_pose(lattice: Lattice, expected: Array, view: Observations, evidence: ViewEvidence) -> Array:
    """The pose (3,) beside the expected one (3,) with tiles on tiles, or that one, as more of the view is on landmarks.

    Joints of tiles say nothing of which tile it is, so evidence does not count them; they say how the tiles lie.
    """
    poses = np.stack([lattice.aligned(expected, view), expected])
    poses[1, 2] = poses[0, 2]
    return np.asarray(poses[np.argmax(evidence.matches(poses))])


def beside_tiles(expected: Array, pose: Array) -> Array:
    """(N, 3) place_from_tracked of an expected pose (3,) where the tracked one (3,) was put onto tiles: none where that
    is the same place. Turned as the tiles are, for others hang along the same walls."""
    there = rival_from_tracked(np.array([[expected[0], expected[1], pose[2]]]), pose)
    return np.asarray(there[~same_places(there, np.zeros((1, 3)))[:, 0]])


def better_of(evidence: ViewEvidence, pose: Array, beside: Array, sigma_m: float) -> Array:
    """A pose (3,), or one (3,) a few centimetres beside it, whichever is likelier: by the view, and because a pose is
    known to sigma_m."""
    fits = combined(evidence.log_ratio(np.stack([pose, beside])))
    off = float(np.hypot(*(beside - pose)[:2])) / sigma_m
    return beside if fits[1] - fits[0] > 0.5 * off**2 else pose
