"""The factor graph of keyframes: odometry between neighbours, closures between visits, one estimate for all.

The graph is small, for it holds keyframes and not scans, so each optimisation is a full one that starts from the last
estimate: 2,271 keyframes with 396 closures take some 15 ms an iteration, and two or three iterations. On a drive so
long that this adds up, closures wait for each other.
"""

from collections.abc import Iterable
from pathlib import Path

import gtsam
import numpy as np

from segslam import geometry
from segslam.config import GraphConfig
from segslam.pose_graph import gnc, noise
from segslam.pose_graph.agreeing import believe_agreeing
from segslam.pose_graph.consistency import agreements, ends_m, neighbours, num_near
from segslam.pose_graph.drift import straightened, turns_per_m
from segslam.pose_graph.edges import Edge, Transforms, factor_graph, joined, poses_by_id, squared_errors
from segslam.pose_graph.g2o import G2oGraph, write_g2o
from segslam.pose_graph.rows import Rows
from segslam.pose_graph.solver import search
from segslam.types import AngleSamples, GraphEstimate, LoopClosure, SegslamError, Transform, Vector

RUNNING_TOLERANCE = 1e-3
"""Where an optimisation ends while running. Chosen: the same trajectories to a centimetre, a third fewer iterations."""
FINAL_TOLERANCE = 1e-5
CLOSURES_PER_WAITING = 200
"""Chosen: of so many closures in the estimate, one more waits for the next optimisation: it tells less, and the time of
all optimisations would grow with the square of the drive. The KITTI drives tried have 86 at most."""
MOST_PAIRED = 5_000
"""Closures of which every two are compared, in 8 s and 450 MB; of more than that, graduated non-convexity decides."""
PLACE_M = 30.0
"""Closures whose ends are this near in travel see the same things, and are wrong together. Chosen."""
VOICES_OF_A_PLACE = 2.0
"""All closures between two places have the say of this many. Chosen of 0.5 to 5 with `tools/bench_back_end.py`: with
less a place of true closures is given up, with more a repeated street outvotes the odometry."""


class PoseGraph:
    """Keyframes of ids 0, 1, 2, ... and the closures among them. It alone owns world poses.

    The world is the odometry's frame as the first keyframe sees it.
    """

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self._measured: list[Edge] = []
        """Odometry as it came."""
        self._odometry: list[Edge] = []
        """The same, straightened if it was."""
        self._closures: list[Edge] = []
        self._trusted = gtsam.NonlinearFactorGraph()
        """The prior of the first pose and the factors of odometry: never doubted."""
        self._doubted = gtsam.NonlinearFactorGraph()
        """The factors of the closures, without robust kernel."""
        self._robust = gtsam.NonlinearFactorGraph()
        """The same under the kernel."""
        self._inlier_bound = noise.inlier_bound(config.inlier_probability, error_allowance=config.error_allowance)
        self._kernel = noise.kernel(config.robust, self._inlier_bound)
        self._values = gtsam.Values()
        self._T_world = Rows(np.empty((0, 4, 4)))
        """The poses of the values."""
        self._num_closures_in_estimate = 0
        self._T_odom_last = np.eye(4)
        self._travel_m = Rows(np.empty(0))

    @property
    def num_keyframes(self) -> int:
        """Those added so far."""
        return len(self._travel_m)

    @property
    def travel_m(self) -> Vector:
        """(n,) travel of each keyframe, by id."""
        return self._travel_m.all()

    @property
    def T_world_keyframes(self) -> Transforms:  # noqa: N802
        """(n, 4, 4) by id: the last estimate, and odometry from there for keyframes that are newer."""
        return self._T_world.all()

    @property
    def is_due(self) -> bool:
        """Whether closures enough wait for an optimisation: one, or more where the estimate has hundreds already."""
        waiting = len(self._closures) - self._num_closures_in_estimate
        return waiting > self._num_closures_in_estimate // CLOSURES_PER_WAITING

    def T_world_keyframe(self, keyframe_id: int) -> Transform:  # noqa: N802
        """The present estimate of one pose. Raises SegslamError for an id that the graph does not hold."""
        if not self._values.exists(keyframe_id):
            raise SegslamError(f"the pose graph holds keyframes 0 to {self.num_keyframes - 1}, not {keyframe_id}")
        return self._values.atPose3(keyframe_id).matrix()

    def add_keyframe(self, keyframe_id: int, T_odom_keyframe: Transform, travel_m: float) -> None:
        """The next keyframe, tied by odometry to the one before. Raises ValueError unless ids count from 0."""
        if keyframe_id != self.num_keyframes:
            raise ValueError(
                f"keyframe ids count from 0 without gaps: expected {self.num_keyframes}, got {keyframe_id}"
            )
        if keyframe_id == 0:
            first = gtsam.Pose3(_exact(T_odom_keyframe))
            self._trusted.add(gtsam.PriorFactorPose3(0, first, noise.first_pose()))
            pose = first
        else:
            T_last_new = _exact(geometry.inverse(self._T_odom_last) @ T_odom_keyframe)
            way_m = travel_m - self.travel_m[-1]
            information = noise.odometry_information(way_m, T_last_new, self._config)
            edge = Edge(keyframe_id - 1, keyframe_id, T_last_new, information)
            self._measured.append(edge)
            self._odometry.append(edge)
            self._trusted.add(edge.factor())
            pose = self._values.atPose3(keyframe_id - 1).compose(gtsam.Pose3(T_last_new))
        self._values.insert(keyframe_id, pose)
        self._T_world.append(pose.matrix())
        self._T_odom_last = T_odom_keyframe
        self._travel_m.append(travel_m)

    def add_closure(self, closure: LoopClosure) -> None:
        """A loop between two keyframes that the graph holds; it takes effect with the next optimisation.

        Raises SegslamError for an unknown keyframe, ValueError for an information that is none.
        """
        for keyframe_id in (closure.target_id, closure.source_id):
            self.T_world_keyframe(keyframe_id)
        information = noise.closure_information(closure.information, self._config)
        edge = Edge(closure.target_id, closure.source_id, _exact(closure.T_target_source), information)
        self._closures.append(edge)
        self._doubted.add(edge.factor())
        self._robust.add(edge.factor(kernel=self._kernel))

    def replace_closures(self, closures: Iterable[LoopClosure]) -> None:
        """The same loops in the same order, measured better; they take effect with the next optimisation."""
        self._closures = []
        self._doubted, self._robust = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
        for closure in closures:
            self.add_closure(closure)

    def straighten(self, samples: AngleSamples) -> None:
        """Turn back in the odometry what leftover angles bent; it takes effect with the next optimisation.

        What an earlier call turned back is put in place again first; keyframes added later are as they come.
        """
        travel_m = self.travel_m
        turned_rad = turns_per_m(samples, (travel_m[:-1] + travel_m[1:]) / 2) * np.diff(travel_m)[:, None]
        self._odometry = straightened(self._measured, turned_rad)
        prior = self._trusted.at(0)
        self._trusted = gtsam.NonlinearFactorGraph()
        self._trusted.add(prior)
        self._trusted.push_back(factor_graph(self._odometry))

    def optimize(self) -> GraphEstimate:
        """The optimum under the robust kernel, searched from the last estimate, good enough to go on with."""
        return self._optimize(RUNNING_TOLERANCE)

    def finish(self) -> GraphEstimate:
        """The final optimum, each closure kept or switched off (unless configured not to).

        Odometry and the first pose are never doubted.
        """
        robust = self._optimize(FINAL_TOLERANCE)
        if self._config.final == "none":
            return robust
        places_m = ends_m(self._closures, self.travel_m)
        says = np.minimum(1.0, VOICES_OF_A_PLACE / num_near(places_m, PLACE_M))
        problem = gnc.TruncatedProblem(self._trusted, self._closures, self._inlier_bound, says=says)
        if self._config.final == "gnc" or len(self._closures) > MOST_PAIRED:
            solution = gnc.solve(problem, self._values)
        else:
            near = neighbours(places_m, PLACE_M)
            agree = agreements(self._odometry, self._closures, self._inlier_bound)
            solution = believe_agreeing(problem, self._values, agree, near)
        self._take(solution.search.values)
        return self._estimate(solution.search.error, solution.weights)

    def write_g2o(self, path: Path) -> None:
        """Poses, odometry and closures (without robust kernel) as g2o text."""
        poses = dict(enumerate(self.T_world_keyframes))
        write_g2o(path, G2oGraph(poses, self._odometry + self._closures))

    def _optimize(self, tolerance: float) -> GraphEstimate:
        found = search(joined(self._trusted, self._robust), self._values, tolerance=tolerance)
        self._take(found.values)
        errors = np.sqrt(squared_errors(self._doubted, self._values))
        weights = [1.0 if self._kernel is None else self._kernel.weight(float(error)) for error in errors]
        return self._estimate(found.error, weights)

    def _take(self, values: gtsam.Values) -> None:
        """Values that all closures so far were part of."""
        self._values = values
        self._T_world = Rows(poses_by_id(values))
        self._num_closures_in_estimate = len(self._closures)

    def _estimate(self, error: float, weights: Iterable[float]) -> GraphEstimate:
        pairs = [(closure.b, closure.a) for closure in self._closures]
        return GraphEstimate(
            dict(enumerate(self.T_world_keyframes)), float(error), dict(zip(pairs, map(float, weights), strict=True))
        )


def _exact(T_a_b: Transform) -> Transform:
    """With a rotation that is one: what rounding leaves in a long chain stops the solver far from the optimum."""
    return geometry.transform(geometry.nearest_rotation(T_a_b[:3, :3]), T_a_b[:3, 3])
