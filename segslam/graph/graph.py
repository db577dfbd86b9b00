"""The factor graph of keyframes: odometry between consecutive keyframes, closures between visits of a place.

The graph holds keyframes, not scans, so it is small. Each optimisation is a full one from the last estimate: 2,271
keyframes with 396 closures take about 15 ms per iteration, and two or three iterations. On very long drives,
several closures are collected before an optimisation.
"""

import logging
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import compress
from pathlib import Path

import gtsam
import numpy as np

from segslam.core import geometry
from segslam.core.config import GraphConfig
from segslam.core.trajectory import Poses, Rows
from segslam.core.types import (
    REJECTED_WEIGHT,
    GraphEstimate,
    Indices,
    Information,
    LoopClosure,
    SegslamError,
    Transform,
    Vector,
)
from segslam.graph import noise
from segslam.graph.adjusted import solve_adjusted, weighted_edges, without_shared_rotation
from segslam.graph.chains import Chains
from segslam.graph.closure_pairs import MAX_PAIRED, Matrices, Pairs, consistent_pairs, largest_consistent
from segslam.graph.edges import (
    Edge,
    factor_graph,
    is_break,
    joined,
    kernel_weights,
    largest_variances,
    poses_by_id,
    relinked,
    rotated,
    values_of,
)
from segslam.graph.g2o import G2oGraph, write_g2o
from segslam.graph.levenberg_marquardt import Search, Unsolvable, search
from segslam.graph.motions import Drive, solve_final, without
from segslam.graph.steady_drift import noise_factor, steady_drift

logger = logging.getLogger(__name__)

RUNNING_TOLERANCE = 1e-3
"""Relative tolerance of the optimisations while running. Chosen: the same trajectories to a centimetre, with a third
fewer iterations."""
CLOSURES_PER_WAITING = 200
"""Chosen: the graph is optimised after 1 + n / 200 new closures, with n closures in the estimate, so that the time of
all optimisations grows linearly with the drive. The KITTI drives tried have 86 closures at most."""
BREAK_LENGTH_M = 1e5
"""Travel that stands for a break, longer than any drive: keyframes across it are near each other along no path."""


class PoseGraph:
    """Keyframes 0, 1, 2, ... and the closures between them. It owns all world poses.

    The world frame is the odometry frame of the first keyframe.
    """

    _first = 0
    """Vertex of the first keyframe; those before it belong to a map, and their ids are negative."""

    def __init__(self, config: GraphConfig) -> None:
        self._configured = config
        self._config = config
        """The configuration with the noise of the odometry that loops show."""
        self._odometry: list[Edge] = []
        self._rejected: list[bool] = []
        """For each motion: whether the last final optimisation rejected it."""
        self._has_breaks = False
        self._has_own_information: list[bool] = []
        """For each motion: whether it was added with its own information."""
        self._closures: list[Edge] = []
        self._prior = gtsam.NonlinearFactorGraph()
        """The factor of the first pose."""
        self._backbone = gtsam.NonlinearFactorGraph()
        """The same and the factors of odometry."""
        self._inlier_bound = noise.inlier_bound(error_allowance=config.error_allowance)
        self._kernel = noise.robust_kernel(config.robust, self._inlier_bound)
        self._values = gtsam.Values()
        self._T_world = Rows(np.empty((0, 4, 4)))
        """The poses in `_values`, as an array."""
        self._weights: list[float] = []
        """Weights of the closures in the last estimate."""
        self._chains: Chains | None = None
        """Chains of the last estimate, continued by odometry; None before the first use."""
        self._adjustment: tuple[list[Edge], list[Edge], tuple[float, float]] | None = None
        """The motions, the relative poses and the factors of noise of the last adjustment."""
        self._finished = gtsam.Values()
        """Poses before the first adjustment."""
        self._T_odom_last = np.eye(4)
        self._path_m = Rows(np.empty(0))
        self._travel_m = Rows(np.empty(0))
        self._num_breaks = Rows(np.empty(0, np.int64))
        self._motion_variance = Rows(np.empty(0))
        self._time_s = Rows(np.empty(0))

    @property
    def num_keyframes(self) -> int:
        """Number of keyframes added so far."""
        return len(self._travel_m) - self._first

    @property
    def travel_m(self) -> Vector:
        """(n,) travel of each keyframe, by id; each break is `BREAK_LENGTH_M` long."""
        return self._travel_m.all()[self._first :]

    @property
    def num_breaks(self) -> Indices:
        """(n,) number of breaks before each keyframe, by id."""
        return self._num_breaks.all()[self._first :]

    @property
    def motion_variance(self) -> Vector:
        """(n,) largest variance of the motion that leads to each keyframe, in any direction (m^2); 0 for the first.

        Where the motion has no information of its own, the variance is by the configured noise: the noise that loops
        raise covers the drift of a whole drive, not of a motion.
        """
        return self._motion_variance.all()[self._first :]

    @property
    def T_world_keyframes(self) -> Poses:  # noqa: N802
        """(n, 4, 4) poses by id: the last estimate, continued by odometry for newer keyframes."""
        return self._T_world.all()[self._first :]

    @property
    def is_due(self) -> bool:
        """True if enough closures wait for an optimisation: one, or more if the estimate has hundreds already."""
        return len(self._closures) - len(self._weights) > len(self._weights) // CLOSURES_PER_WAITING

    def add_keyframe(
        self,
        keyframe_id: int,
        T_odom_keyframe: Transform,
        travel_m: float,
        *,
        information: Information | None = None,
        stamp_ns: int | None = None,
    ) -> None:
        """Add the next keyframe, with an odometry edge from the one before. `travel_m`: length of the path to it.

        `information` of the motion from the last keyframe (tangent in the new keyframe) replaces the noise model of
        odometry: a repaired motion has the information of its registration, an unknown one almost none. The first
        keyframe has no motion, and ignores it.
        Raises ValueError unless ids count from 0, and for an information that is not positive semidefinite.
        """
        if keyframe_id != self.num_keyframes:
            expected = f"expected {self.num_keyframes}, got {keyframe_id}"
            raise ValueError(f"keyframe ids count from 0 without gaps: {expected}")
        vertex = keyframe_id + self._first
        if vertex == 0:
            variance, num_breaks = 0.0, 0
            pose = gtsam.Pose3(geometry.nearest_transform(T_odom_keyframe))
            self._prior.add(gtsam.PriorFactorPose3(0, pose, noise.FIRST_POSE))
            self._backbone.push_back(self._prior)
        else:
            # Rounding in a long chain would stop the solver far from the optimum.
            T_last_new = geometry.nearest_transform(geometry.inverse(self._T_odom_last) @ T_odom_keyframe)
            way_m = travel_m - self._path_m.all()[-1]
            if keyframe_id == 0:
                information = np.zeros((6, 6))  # nothing is known of its motion from a map
            known, configured = (
                noise.motion_information(information)
                if information is not None
                else noise.odometry_information(way_m, T_last_new, config)
                for config in (self._config, self._configured)
            )
            edge = Edge(vertex - 1, vertex, T_last_new, known)
            self._has_own_information.append(information is not None)
            self._has_breaks |= is_break(edge)  # also where loops show that the odometry errs more
            num_breaks = int(self._num_breaks.all()[-1]) + (information is not None and is_break(edge))
            self._odometry.append(edge)
            self._rejected.append(False)
            self._backbone.add(edge.factor())
            variance = largest_variances(configured)[1]
            pose = self._values.atPose3(vertex - 1).compose(gtsam.Pose3(T_last_new))
        self._values.insert(vertex, pose)
        self._T_world.append(pose.matrix())
        if self._chains is not None:
            self._chains.add(pose.matrix(), self._odometry[-1])
        self._T_odom_last = T_odom_keyframe
        self._path_m.append(travel_m)
        self._travel_m.append(travel_m + BREAK_LENGTH_M * num_breaks)
        self._num_breaks.append(num_breaks)
        self._motion_variance.append(variance)
        self._time_s.append(np.nan if stamp_ns is None else 1e-9 * stamp_ns)

    def add_closure(self, closure: LoopClosure) -> None:
        """Add a loop between two keyframes of the graph; the next optimisation uses it.

        Raises SegslamError for an unknown keyframe, ValueError for an invalid information matrix.
        """
        self._closures.append(self._edge(closure))

    def covariances(self, keyframe_id: int, others: Indices) -> Matrices:
        """(k, 6, 6) covariance of the pose of a keyframe in each of others, as a tangent of the keyframe.

        By the shortest chain of odometry and of the loops that the last estimate kept (`Chains`).
        """
        if self._chains is None:
            self._chains = Chains(self._T_world.all(), self._kept_odometry(), self._kept())
        return self._chains.covariances(keyframe_id + self._first, others + self._first)

    def consistent_pairs(self, closures: Sequence[LoopClosure]) -> Pairs:
        """(k, k) which two closures are consistent with each other and the odometry between their ends.

        The closures need not be in the graph, but their keyframes must be.
        """
        return consistent_pairs(self._kept_odometry(), list(map(self._edge, closures)), self._inlier_bound)

    def agreeing_pairs(self, closures: Sequence[LoopClosure]) -> Pairs:
        """(k, k) which two of these are consistent and are evidence for each other: no break is between their ends.

        Across a break, any two are consistent.
        """
        part = self.num_breaks[np.array([closure.pair for closure in closures], dtype=np.int64).reshape(-1, 2)]
        return self.consistent_pairs(closures) & (part[:, None] == part).all(axis=2)

    def multiply_odometry_noise(self, factor: float) -> None:
        """Increase the noise of odometry, from the next optimisation on, and of keyframes added later."""
        sigma_m, sigma_deg = factor * self._config.odometry_sigma_m, factor * self._config.odometry_sigma_deg
        update = {"odometry_sigma_m": sigma_m, "odometry_sigma_deg": sigma_deg}
        self._use_noise_of(self._config.model_copy(update=update))

    def _use_noise_of(self, config: GraphConfig) -> None:
        """Motions that came with an information keep it."""
        self._config = config
        ways_m = np.diff(self._path_m.all()).tolist()
        self._odometry = [
            edge if own else replace(edge, information=noise.odometry_information(way_m, edge.T_a_b, config))
            for edge, own, way_m in zip(self._odometry, self._has_own_information, ways_m, strict=True)
        ]
        self._rebuild_backbone()

    def weigh_odometry_by(self, closure: LoopClosure) -> None:
        """Increase the noise of odometry until the drift measured by a certain closure is a usual one.

        Drift is usual if its chi-square equals the number of degrees of freedom. Nothing changes across a
        break or a motion that the last estimate rejected.
        """
        factor = noise_factor(self._kept_odometry(), self._edge(closure))
        if factor > 1.0:
            self.multiply_odometry_noise(factor)

    def optimize(self, *, tolerance: float = RUNNING_TOLERANCE) -> GraphEstimate:
        """Optimise under the robust kernel from the last estimate, to this relative tolerance of the error."""
        factors = joined(self._backbone, factor_graph(self._closures, kernel=self._kernel))
        start = self._linked()
        try:
            found = search(factors, start, tolerance=tolerance)
        except Unsolvable as error:
            logger.warning("the poses remain as they were before the last loops: %s", error)
            found = Search(start, factors.error(start), 0, converged=False)
        self._take(found.values, kernel_weights(self._closures, found.values, self._kernel))
        return self._estimate(found.error)

    def finish(self) -> GraphEstimate:
        """Final optimisation, in which each closure is kept or rejected (unless `final` is `none`).

        `consistent` also rejects motions of the odometry that closures of more than one place contradict.
        """
        self._adjustment = None
        robust = self.optimize(tolerance=1e-5)
        if self._config.final == "none":
            return robust
        try:
            error = self._solve_final()
        except Unsolvable as why:
            logger.warning("no final optimisation, the estimate under the robust kernel remains: %s", why)
            return robust
        if self._corrects_steady_drift():
            with suppress(Unsolvable):  # the solution before remains
                error = self._solve_final()
        return self._estimate(error)

    def adjust(self, measured: Sequence[Edge], *, shared_within: int = 0) -> tuple[GraphEstimate, tuple[float, float]]:
        """The estimate with further relative poses, after `finish`, and factors of noise (`solve_adjusted`).

        Rejected closures and motions stay rejected. `measured` replaces that of an earlier call. Measurements of at
        most `shared_within` keyframes' distance show the rotation that all motions share, which is removed for it.
        """
        odometry, closures = without_shared_rotation(self._kept_odometry(), measured, shared_within), self._kept()
        found, factors = solve_adjusted(self._prior, odometry, closures, measured, self._values, self._kernel)
        if self._adjustment is None:
            self._finished = self._values
        self._take(found.values, self._weights)
        self._adjustment = odometry, list(measured), factors
        return self._estimate(found.error), factors

    def drop_adjustment(self) -> None:
        """Return to the result of `finish`."""
        self._take(self._finished, self._weights)
        self._adjustment = None

    def _solve_final(self) -> float:
        """Take the final solution; returns its error."""
        drive = Drive(self._prior, self._closures, self._travel_m.all(), self._inlier_bound)
        pairwise = self._config.final != "gnc"
        final = solve_final(drive, self._odometry, self._values, np.array(self._rejected, bool), pairwise=pairwise)
        self._rejected = final.rejected.tolist()
        self._rebuild_backbone()
        self._take(final.solution.search.values, final.solution.weights)
        return final.solution.search.error

    def _corrects_steady_drift(self) -> bool:
        """Correct a steady drift of the heading, if that explains a drift beyond the tolerated errors."""
        growth = np.column_stack([np.diff(self._path_m.all()), np.nan_to_num(np.diff(self._time_s.all()))])
        growth[np.array([self._has_own_information, self._rejected], dtype=bool).any(axis=0)] = 0.0
        raised = self._config
        self._use_noise_of(self._configured)
        found, odometry = None, self._kept_odometry()
        with suppress(Unsolvable):
            tolerated = raised.error_allowance
            found = steady_drift(self._prior, odometry, self._kept(), growth, self._values, tolerated=tolerated)
        if found is None:
            self._use_noise_of(raised)
            return False
        self._odometry = rotated(self._odometry, found.turns)
        self.multiply_odometry_noise(found.noise_factor)
        self._take(found.values, self._weights)
        return True

    def write_g2o(self, path: Path) -> None:
        """Poses, odometry and closures (without robust kernel) as g2o text."""
        write_g2o(path, G2oGraph(dict(enumerate(self._T_world.all())), self._kept_odometry() + self._closures))

    def write_adjusted_g2o(self, path: Path) -> None:
        """Poses and all edges of the last estimate, those of the adjustment included, as g2o text.

        The information is that with which an edge acts: rejected closures are omitted, robust weights are applied.
        """
        odometry, measured, factors = self._adjustment or (self._kept_odometry(), [], (1.0, 1.0))
        edges = weighted_edges(odometry, self._kept(), measured, factors, self._values, self._kernel)
        write_g2o(path, G2oGraph(dict(enumerate(self._T_world.all())), edges))

    def _edge(self, closure: LoopClosure) -> Edge:
        ids = closure.target_id, closure.source_id
        for keyframe_id in ids:
            if not -self._first <= keyframe_id < self.num_keyframes:
                raise SegslamError(f"the pose graph holds keyframes 0 to {self.num_keyframes - 1}, not {keyframe_id}")
        a, b = (keyframe_id + self._first for keyframe_id in ids)
        T_target_source = geometry.nearest_transform(closure.T_target_source)
        return Edge(a, b, T_target_source, noise.closure_information(closure.information))

    def _kept(self) -> list[Edge]:
        """The closures that the last estimate kept."""
        return list(compress(self._closures, [weight >= REJECTED_WEIGHT for weight in self._weights]))

    def _kept_odometry(self) -> list[Edge]:
        return without(self._odometry, self._rejected)

    def _rebuild_backbone(self) -> None:
        self._backbone = joined(self._prior, factor_graph(self._kept_odometry()))
        self._chains = None

    def _linked(self) -> gtsam.Values:
        """The last estimate, with segments between breaks moved to satisfy consistent closures, up to `MAX_PAIRED`."""
        if not self._has_breaks or not 0 < len(self._closures) <= MAX_PAIRED:
            return self._values
        odometry = self._kept_odometry()
        likely = largest_consistent(consistent_pairs(odometry, self._closures, self._inlier_bound))
        return values_of(relinked(odometry, self._closures, self._T_world.all(), likely))

    def _take(self, values: gtsam.Values, weights: Iterable[float]) -> None:
        """Store poses, and the weights of all closures so far."""
        self._values, self._weights = values, list(map(float, weights))
        self._T_world = Rows(poses_by_id(values))
        self._chains = None

    def _estimate(self, error: float) -> GraphEstimate:
        pairs = [(closure.b - self._first, closure.a - self._first) for closure in self._closures]
        return GraphEstimate(
            dict(enumerate(self.T_world_keyframes)),
            float(error),
            dict(zip(pairs, self._weights, strict=True)),
            {(edge.a - self._first, edge.b - self._first): 0.0 for edge in compress(self._odometry, self._rejected)},
        )
