"""The joint least squares of a frame's lines: one direction, the robot's tilt, one offset a line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ceilvo.config import Features
from ceilvo.daemon.vision import kernel, tilt_prior
from ceilvo.daemon.vision.edge_points import Array32, Points
from ceilvo.daemon.vision.kernel.arguments import Step
from ceilvo.daemon.vision.kernel.of_lines import centred, merged, neighbours
from ceilvo.daemon.vision.rolling_shutter import Readout
from ceilvo.daemon.vision.tilt_prior import UNKNOWN, Borne, Lately, TiltPrior, is_tilt, is_weak, widened
from ceilvo.robust import MAD_TO_SIGMA
from ceilvo.types import Array, Ints

LAST_GATE_PX = (0.8, 2.0)
"""Bounds of the last gate; 0.8 from the prototype's gates of 2.2, 1.2 and 0.8, 2 for jagged edges: chosen."""
_LAST_GATE_SIGMAS = 3.0
"""Between the bounds, in standard deviations of the points: 99.7 % of normal noise."""
_CORRELATED_POINTS = 27.0
"""Neighbours on a line that share one error where all edge points are used; chosen: too few make motions claim too
much, which `make bench-vision` shows in column NEES/3 (docs/bench.md)."""
_SIGMA_FLOOR_PX = 0.02
"""Least standard deviation of points and of offsets; chosen: more points do not average out what is no noise."""
_DIRECTION_INFO = 1e-3
"""rad^-2, of the direction beforehand: as good as none, but no line may leave the equations singular."""
_HELD_PRIOR_DEG = 1e-6
"""Standard deviation of a tilt that is held, as good as 0 in double precision."""
_VAGUE_RAD, _LEVEL_RAD = np.radians(0.1), np.radians(0.05)
"""A tilt known worse tells nothing where a level robot may show it, by pieces of lines and by whole ones; chosen."""
_SPREAD_STRIDE = 3
"""Every third point tells the spread; chosen: saves time, hundreds remain."""
_DOUBT_RAD, _DOUBT_SIGMAS = np.radians(0.3), 3.0
"""A tilt this far from the expected one is tried again from there, or so many standard deviations of the prior, where
that is more (99.7 %); chosen: 11 mm on a ceiling 2.2 m high."""
_DOUBLE, _DOUBLE_ROUNDS = 2.0, 3
"""A line is two whose points scatter by so many times what half of the points do; and how often that is asked; chosen:
two lines half a pixel apart scatter by four times as much, and what they bent by twice at first."""
_BENT_SIGMAS = 2.0
"""A direction by whole lines that is off that of lines without gaps by more, in standard deviations of the latter, is
by pieces of several lines; chosen: 5 % of those that are right lose accuracy."""
_LEAST_OF_LONGEST = 0.25
"""A shorter piece, against the longest of its line, is none; chosen: clutter in a gap is of one or two points."""


class JointFit:
    """Joint least squares: n(psi) . p(tilt) = offset of the point's line.

    Attributes:
        psi: rad, direction of axis 0's normal.
        tilt: (2,) rad about base x and y.
        covariance: (3, 3) of psi and tilt, rad^2.
        offset, line_group, support: (L,) px, group of the line (see vision.kernel), and points it was fitted to.
        line: (P,) a point's line.
        rho, tangent: (P,) coordinates across and along it, as rays of a level robot.
        noise_px: standard deviation of the points about their lines.
        focal_px: of the level view.
        correlated: points that share one error.
    """

    def __init__(
        self,
        points: Points,
        psi: float,
        starts: list[Array],
        focal_px: float,
        config: Features,
        fraction: float,
        tilt_rad: Array,
        readout: Readout | None = None,
        several: bool = False,
    ) -> None:
        """several: the ceiling has several heights, so that a line may be two."""
        self.psi = psi
        self._by_pieces: tuple[Array, Array] | None = None  # the tilt, and the error of that
        self._whole: tuple[float, Array, Array] | None = None
        self._borne = UNKNOWN
        self.tilt = tilt_rad
        self.focal_px, self._config, self._readout, self._several = focal_px, config, readout, several
        self.correlated = 1.0 + _CORRELATED_POINTS * fraction
        self._x, self._y, self.ends = points.x, points.y, points.ends
        self.restart(starts)
        self.covariance = np.eye(3)
        self.noise_px = 1.0
        self.rho, self.tangent = kernel.project(self._x, self._y, self.ends[2], self.psi, self.tilt)

    @property
    def axis(self) -> Ints:
        return np.asarray(self.line_group // 2, np.int64)

    def picture(self, new_of_old: Ints) -> tuple[Array32, Ints]:
        """(Q, 2) px of the remaining points as a level robot would see them, and (Q,) the new number of their lines.

        Args:
            new_of_old: (L,) of each line; -1 leaves its points out.
        """
        return kernel.picture(self.rho, self.tangent, self.line, self.ends[2], self.psi, self.focal_px, new_of_old)

    def extents(self) -> tuple[Array, Array]:
        """Where the points of every line (L,) begin and end along it, px."""
        low, high = kernel.extents(self.tangent, self.line, len(self.offset))
        return low * self.focal_px, high * self.focal_px

    def assign(self, gate_px: float) -> None:
        """Give every point the nearest line of its axis and polarity within the gate; drop points of no line."""
        offset, gate = self.offset / self.focal_px, gate_px / self.focal_px
        self._x, self._y, self.rho, self.tangent, self.line, self.ends = kernel.assign(
            self._x, self._y, self.rho, self.tangent, self.ends, offset, self.line_group, gate
        )

    def restart(self, starts: list[Array]) -> None:
        """Lines to fit, by their offsets in each group."""
        self.offset = np.concatenate(starts)
        self.line_group = np.repeat(np.arange(4), [len(s) for s in starts])
        self.support = np.zeros(len(self.offset), np.int64)

    def is_doubtful(self, expected_rad: Array, prior: TiltPrior | None) -> bool:
        """Whether the tilt found is far from what was expected: then a false optimum is possible."""
        off = np.abs(self.tilt - expected_rad)
        spread = _DOUBT_RAD if prior is None else np.maximum(_DOUBT_SIGMAS * prior.sigma_rad, _DOUBT_RAD)
        return bool(np.any(off > spread))

    def is_vague(self, free: TiltPrior, prior: TiltPrior | None, usual_rad: Array) -> bool:
        """Whether hardly anything is known of the tilt, from this frame, as finish() gave it, or from others;
        usual_rad: (2,) what is none, but what these lines show as well."""
        open_rad = float(np.max(free.sigma_rad)) if prior is None else 0.0
        if open_rad <= _LEVEL_RAD:
            return False
        tilts = len(self.line) > 0 and is_tilt(self.tilt - usual_rad, self.covariance)
        return not (self._tilts_for_sure(usual_rad) if tilts and open_rad > _VAGUE_RAD else tilts)

    def _tilts_for_sure(self, usual_rad: Array) -> bool:
        """Whether a level robot is hardly possible, however little is known of its tilt, by lines without gaps."""
        if self._by_pieces is None:
            moved, cov = self._step_by_pieces(*self._pieces())
            self._by_pieces = self.tilt + moved[1:], widened(cov)
        tilt, cov = self._by_pieces
        return is_tilt(tilt - usual_rad, cov)

    def _step_by_pieces(self, pieces: NDArray[np.int32], count: int, tilt: bool = True) -> tuple[Array, Array]:
        """(3,) by how much direction and tilt are off by lines that end at their gaps, and (3, 3) the error of that."""
        _, _, moved, cov = self._step(self.rho, self.tangent, pieces, self.ends[2], count, tilt)
        return moved, cov

    def _pieces(self) -> tuple[NDArray[np.int32], int]:
        """(P,) the piece of its line that each point is on, where lines end at gaps, and how many pieces there are."""
        gap = np.radians(self._config.min_line_deg)
        order = np.lexsort((self.tangent, self.line))
        ends = (np.diff(self.line[order]) != 0) | (np.diff(self.tangent[order]) > gap)
        pieces = np.zeros(len(order), np.int32)
        pieces[order[1:]] = np.cumsum(ends)
        return pieces, int(pieces.max()) + 1

    def start(self, line_of_point: NDArray[np.int32], expected_offset: Array) -> None:
        """Begin from given lines instead of gates: the line of every point, in the points' order."""
        self.line = line_of_point
        self.offset = expected_offset

    def last_gate_px(self) -> float:
        """A few standard deviations of the points that fit, in bounds: jagged edges need more than clean ones."""
        sigma = MAD_TO_SIGMA * kernel.spread(self.rho, self.line, self.offset, self.focal_px, _SPREAD_STRIDE)
        return min(max(_LAST_GATE_SIGMAS * sigma, LAST_GATE_PX[0]), LAST_GATE_PX[1])

    def solve(self, tilt: bool = True) -> None:
        """One Gauss-Newton step on (psi, tilt); the offsets are eliminated by centring every line.

        Args:
            tilt: False holds the tilt where it is.
        """
        self._solve(self.rho, self.tangent, self.line, self.ends[2], tilt)

    def _solve(self, rho: Array32, tangent: Array32, line: NDArray[np.int32], half: int, tilt: bool) -> None:
        """By some of the points, of which those before `half` belong to axis 0."""
        lines = len(self.offset)
        self.support, self.noise_px, moved, self.covariance = self._step(rho, tangent, line, half, lines, tilt)
        self.psi += float(moved[0])
        self.tilt = self.tilt + moved[1:]
        self._settle()

    def _step(
        self, rho: Array32, tangent: Array32, line: NDArray[np.int32], half: int, lines: int, tilt: bool
    ) -> tuple[Ints, float, Array, Array]:
        """As kernel.fit, by any points of any lines."""
        held = not (tilt and self._config.estimate_tilt)
        prior_rad = float(np.radians(_HELD_PRIOR_DEG if held else self._config.tilt_prior_deg))
        step = Step(self.focal_px, self.correlated, _SIGMA_FLOOR_PX, _DIRECTION_INFO, prior_rad**-2, held)
        return kernel.fit(rho, tangent, line, half, lines, self.psi, self.tilt, step)

    def _unbend(self, tilt: bool = True) -> None:
        """Take out what is wrong with the twist by which a rolling shutter's rows were brought to one instant.

        One step on (psi, tilt, twist); psi and tilt follow from the next solve().
        """
        assert self._readout is not None
        half, c, s = self.ends[2], np.cos(self.psi), np.sin(self.psi)
        by_x, by_y = self._readout.moved_by(self._x, self._y)
        first, second = c * by_x + s * by_y, c * by_y - s * by_x
        by_twist = np.vstack([first[:half], second[half:]])
        model = centred(self.rho, self.tangent, self.line, half, len(self.offset), by_twist) * self.focal_px
        product = model.T @ model / (self.noise_px**2 * self.correlated)
        held = not (tilt and self._config.estimate_tilt)
        turn_info = np.radians(_HELD_PRIOR_DEG if held else self._config.tilt_prior_deg) ** -2
        info = product[1:, 1:] + np.diag([_DIRECTION_INFO, turn_info, turn_info, *self._readout.twist_info])
        wrong = np.linalg.solve(info, -product[1:, 0])[3:]
        self._x = (self._x + by_x @ wrong).astype(np.float32)
        self._y = (self._y + by_y @ wrong).astype(np.float32)
        self._settle()

    def _borne_by(self) -> Borne:
        """How lines bear the tilt: those side by side, such as edges of one lamp, are mistaken alike."""
        n, variance = len(self.offset), self.noise_px**2 * self.correlated
        model = centred(self.rho, self.tangent, self.line, self.ends[2], n, np.zeros((len(self.line), 0)))
        before = np.diag([_DIRECTION_INFO, *[np.radians(self._config.tilt_prior_deg) ** -2] * 2])
        low, high = kernel.extents(self.tangent, self.line, n)
        part_of = neighbours(self.offset / self.focal_px, self.axis, tilt_prior.SIDE_BY_SIDE)
        return Borne.by(model * self.focal_px / np.sqrt(variance), self.line, before, high - low, part_of)

    def held_rad(self, free: TiltPrior, lately: Lately) -> float:
        """To what a tilt that is held level is known: by the scatter of those lately, and by how far this frame's (of
        finish()) is off them beyond its error, where enough lines bear it."""
        if lately.about_rad is None or not self._borne.by_many:
            return lately.scatter_rad
        beyond2 = (free.mean_rad - lately.about_rad) ** 2 - free.sigma_rad**2
        return max(lately.scatter_rad, float(np.sqrt(max(np.max(beyond2), 0.0))))

    def finish_held(self, pieces: bool = True, held_rad: float = 0.0) -> None:
        """The last round with the tilt where it is, known to held_rad; pieces: lines that are several are cut."""
        if self._readout is not None:
            self._unbend(tilt=False)
        self.assign(self.last_gate_px())
        self.solve(tilt=False)
        if pieces and len(self.line):
            self._straighten()
        self.covariance = self.covariance + np.diag([0.0, *[max(tilt_prior.HELD_RAD, held_rad) ** 2] * 2])

    def _straighten(self) -> None:
        """Lines that are no single ones cut in pieces: the outer edge of one lamp and the inner one of the next, taken
        for one line, turn all of it by a degree, and are sure of it."""
        pieces, count = self._pieces()
        moved, cov = self._step_by_pieces(pieces, count, tilt=False)
        if count == len(self.offset) or moved[0] ** 2 < _BENT_SIGMAS**2 * cov[0, 0]:
            return
        points = np.bincount(pieces, minlength=count)
        lines, of_line = len(self.offset), np.zeros(count, np.int64)
        of_line[pieces] = self.line
        self.line, self.line_group, self.offset = pieces, self.line_group[of_line], np.zeros(count)
        self.psi += float(moved[0])
        self._settle()
        longest = np.zeros(lines, np.int64)
        np.maximum.at(longest, of_line, points)
        gate_px, long = self.last_gate_px(), points >= _LEAST_OF_LONGEST * longest[of_line]
        self.restart([merged(self.offset[long & (self.line_group == group)]) for group in range(4)])
        self.assign(gate_px)
        self.solve(tilt=False)
        if len(self.line):
            self.covariance[0, 0] = self._step_by_pieces(*self._pieces(), tilt=False)[1][0, 0]

    def apply_prior(self, prior: TiltPrior) -> bool:
        """Combine with what is known of the tilt, unless the two disagree; psi follows through its correlation.

        Blurred pieces are a degree off and sure of it: where they disagree it is by whole lines.
        """
        (off_x, off_y), cov = (prior.mean_rad - self.tilt).tolist(), self.covariance.tolist()
        sigma_x, sigma_y = prior.sigma_rad.tolist()
        a, b, c, d = cov[1][1] + sigma_x**2, cov[1][2], cov[2][1], cov[2][2] + sigma_y**2
        det = a * d - b * c
        a, b, c, d = d / det, -b / det, -c / det, a / det  # plain numbers: numpy takes longer to be asked
        if (a * off_x + b * off_y) * off_x + (c * off_x + d * off_y) * off_y > tilt_prior.TILT_CHI2:
            if self._whole is not None:
                whole, self._whole = self._whole, None
                self._be(*whole)
                return self.apply_prior(prior)
            return False
        gain = [(r[1] * a + r[2] * c, r[1] * b + r[2] * d) for r in cov]
        turn, x, y = (u * off_x + v * off_y for u, v in gain)
        self.covariance = np.array(
            [[r[k] - (u * cov[1][k] + v * cov[2][k]) for k in range(3)] for r, (u, v) in zip(cov, gain, strict=True)]
        )
        self.psi += turn
        self.tilt = self.tilt + np.array([x, y])
        self._settle()
        return True

    def _settle(self) -> None:
        """Turn the seen rays back by the robot's tilt, with offsets as the means of their points."""
        self.rho, self.tangent, self.offset = kernel.settle(
            self._x, self._y, self.line, self.ends[2], self.psi, self.tilt, self.focal_px, self.offset
        )

    def finish(self, pieces: bool = True, rocking: bool = False) -> TiltPrior:
        """The last round; returns the tilt by this frame's whole lines; pieces: where vague, use those without gaps."""
        if self._readout is not None:
            self._unbend()
        self.assign(self.last_gate_px())
        self.solve()
        if self._several and len(self.line):
            self._leave_out_double()
        estimated = self._config.estimate_tilt and len(self.line) > 0
        own = self.covariance
        wide = self.covariance = widened(own, rocking)
        if estimated and is_weak(own):
            self._borne = self._borne_by()
            self.covariance = widened(own, rocking, self._borne)
        free = TiltPrior(self.tilt, np.sqrt(self.covariance[[1, 2], [1, 2]]))
        if estimated and pieces and not self._several and np.max(wide[[1, 2], [1, 2]]) > _VAGUE_RAD**2:
            return self._trust_pieces(free, wide)
        return free

    def _trust_pieces(self, free: TiltPrior, wide: Array) -> TiltPrior:
        """A tilt by lines without gaps, if those know it better: edges of two lamps, taken for one line, tilt. Several
        do alike, so where pieces do not bear out that the robot tilts the error of whole lines is wide (3, 3) again."""
        moved, cov = self._step_by_pieces(*self._pieces())
        apart, cov = tilt_prior.are_apart(moved[1:], cov), tilt_prior.PIECES_FACTOR * cov
        self._by_pieces = self.tilt + moved[1:], cov
        if apart and not is_tilt(*self._by_pieces) and is_tilt(self.tilt, self.covariance):
            self.covariance = wide
            free = TiltPrior(self.tilt, np.sqrt(wide[[1, 2], [1, 2]]))
        if np.max(cov[[1, 2], [1, 2]]) < np.max(self.covariance[[1, 2], [1, 2]]):
            self._whole = self.psi, self.tilt, self.covariance
            self._be(self.psi + float(moved[0]), self.tilt + moved[1:], cov)
        return free

    def _be(self, psi: float, tilt: Array, covariance: Array) -> None:
        self.psi, self.tilt, self.covariance = psi, tilt, covariance
        self._settle()

    def _leave_out_double(self) -> None:
        """Direction and tilt without lines that are two, of different heights, which meet: those seem bent by tilt."""
        rho, tangent, line, half = self.rho, self.tangent, self.line, self.ends[2]
        for _ in range(_DOUBLE_ROUNDS):
            off2 = (self.rho - (self.offset / self.focal_px).astype(np.float32)[self.line]) ** 2
            count = np.bincount(self.line, minlength=len(self.offset))
            scatter = np.sqrt(np.bincount(self.line, off2, len(self.offset)) / np.maximum(count, 1))
            usual = np.sort(scatter[self.line])[len(self.line) // 2]
            single = scatter <= _DOUBLE * usual
            of = single[self.line]
            rho, tangent, line = self.rho[of], self.tangent[of], self.line[of]
            half = int(np.count_nonzero(of[: self.ends[2]]))
            self._solve(rho, tangent, line, half, tilt=True)
        self.support = np.bincount(self.line, minlength=len(self.offset))

    def sigma_px(self) -> Array:
        """Standard deviations of the offsets."""
        return np.asarray(self.noise_px * np.sqrt(self.correlated / np.maximum(self.support, 1)) + _SIGMA_FLOOR_PX)
