"""The factor graph of keyframes: odometry between neighbours, closures between visits, one estimate for all.

The graph is small, for it holds keyframes and not scans, so each optimisation is a full one that starts from the last
estimate: 2,270 keyframes with 395 closures take some 15 ms an iteration, and two to four iterations.
"""

from collections.abc import Iterable
from pathlib import Path

import gtsam
import numpy as np
from jaxtyping import Float

from segslam import geometry
from segslam.config import GraphConfig
from segslam.pose_graph import gnc, noise
from segslam.pose_graph.closures import Closure, pose3, squared_errors
from segslam.pose_graph.solver import optimum
from segslam.types import GraphEstimate, LoopClosure, SegslamError, Transform, Vector


class PoseGraph:
    """Keyframes of ids 0, 1, 2, ... and the closures among them. It alone owns world poses.

    The world is the odometry's frame as the first keyframe sees it.
    """

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self._odometry = gtsam.NonlinearFactorGraph()
        """The prior of the first pose and the factors of odometry: never doubted."""
        self._closures: list[Closure] = []
        self._values = gtsam.Values()
        self._T_odom_last = np.eye(4)
        self._travel_m: list[float] = []

    @property
    def num_keyframes(self) -> int:
        return len(self._travel_m)

    @property
    def travel_m(self) -> Vector:
        """(n,) travel of each keyframe, by id."""
        return np.array(self._travel_m)

    @property
    def T_world_keyframes(self) -> Float[np.ndarray, "_ 4 4"]:  # noqa: N802
        """(n, 4, 4) by id: the last estimate, and odometry from there for keyframes that are newer."""
        return poses_by_id(self._values)

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
            first = pose3(T_odom_keyframe)
            self._odometry.add(gtsam.PriorFactorPose3(0, first, noise.first_pose()))
            self._values.insert(0, first)
        else:
            T_last_new = geometry.inverse(self._T_odom_last) @ T_odom_keyframe
            model = noise.odometry(travel_m - self._travel_m[-1], T_last_new, self._config)
            motion = pose3(T_last_new)
            self._odometry.add(gtsam.BetweenFactorPose3(keyframe_id - 1, keyframe_id, motion, model))
            self._values.insert(keyframe_id, self._values.atPose3(keyframe_id - 1).compose(motion))
        self._T_odom_last = T_odom_keyframe
        self._travel_m.append(travel_m)

    def add_closure(self, closure: LoopClosure) -> None:
        """A loop between two keyframes that the graph holds; it takes effect with the next optimisation.

        Raises SegslamError for an unknown keyframe, ValueError for an information that is none.
        """
        for keyframe_id in (closure.target_id, closure.source_id):
            self.T_world_keyframe(keyframe_id)
        information = noise.closure_information(closure.information, self._config)
        measured = pose3(closure.T_target_source)
        self._closures.append(Closure(closure.target_id, closure.source_id, measured, information))

    def optimize(self) -> GraphEstimate:
        """The optimum under the robust kernel, searched from the last estimate."""
        kernel = noise.kernel(self._config)
        graph = gtsam.NonlinearFactorGraph(self._odometry)
        for closure in self._closures:
            graph.add(closure.factor(kernel=kernel))
        self._values = optimum(graph, self._values)
        errors = np.sqrt(squared_errors(self._closures, self._values))
        weights = [1.0 if kernel is None else kernel.weight(float(error)) for error in errors]
        return self._estimate(graph.error(self._values), weights)

    def finish(self) -> GraphEstimate:
        """The final optimum, each closure kept or switched off by graduated non-convexity (unless configured not to).

        Odometry and the first pose are never doubted.
        """
        if self._config.final == "none":
            return self.optimize()
        self.optimize()
        problem = gnc.TruncatedProblem(self._odometry, self._closures, noise.inlier_bound(self._config))
        self._values, weights = gnc.solve(problem, self._values)
        return self._estimate(problem.weighted(weights).error(self._values), weights)

    def write_g2o(self, path: Path) -> None:
        """Poses, odometry and closures (without robust kernel) as g2o text."""
        graph = gtsam.NonlinearFactorGraph()
        for i in range(1, self._odometry.size()):
            graph.add(self._odometry.at(i))
        for closure in self._closures:
            graph.add(closure.factor())
        gtsam.writeG2o(graph, self._values, str(path))

    def _estimate(self, error: float, weights: Iterable[float]) -> GraphEstimate:
        pairs = [(closure.source_id, closure.target_id) for closure in self._closures]
        return GraphEstimate(
            dict(enumerate(self.T_world_keyframes)), float(error), dict(zip(pairs, map(float, weights), strict=True))
        )


def poses_by_id(values: gtsam.Values) -> Float[np.ndarray, "_ 4 4"]:
    """All poses, ascending in their key."""
    rows = np.asarray(gtsam.utilities.extractPose3(values)).reshape(-1, 12)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses
