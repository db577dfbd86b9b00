"""Wrong motions of an odometry are detected with the scans, and repaired."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from helpers.drives import RADIUS_M, STEP_M, round_drive, round_sweeps
from scipy.linalg import eigh

from segslam.core import geometry
from segslam.core.config import Config, load_config
from segslam.core.evaluation import trajectory_metrics
from segslam.core.types import Motion, MotionState, Registration, Rejected, RejectReason, Scan, Step, Trajectory
from segslam.graph.graph import BREAK_LENGTH_M
from segslam.graph.noise import odometry_information
from segslam.labels.label_files import unlabelled
from segslam.odometry import local_map
from segslam.odometry.checked import CheckedOdometry
from segslam.odometry.kiss import KissOdometry
from segslam.odometry.likelihood import Correlation, Errors, Fit, fit
from segslam.odometry.local_map import LocalMap, SeenScan, Voxels
from segslam.odometry.motion_model import WINDOW, Intervals, MotionModel, information_of
from segslam.odometry.nudge import POLISH_VOXELS, nudge
from segslam.odometry.scan_to_map import Proposed, ScanToMap
from segslam.odometry.search import PoseSearch, as_likely
from segslam.odometry.sweep import GivenOdometry, OdometryResult
from segslam.odometry.tracker import Tracker
from segslam.registration import refinement
from segslam.registration.refinement import SHARED_NOISE_DEG, SHARED_NOISE_M, LightSurface
from segslam.registration.refinement import refine as refined
from segslam.scans import open_dataset
from segslam.slam.slam import Slam
from segslam.verification import register

CONFIG = load_config(None, ["proximity.min_travel_m=60"])
SLIP_AT = 20
NO_ERRORS = Errors(np.empty((0, 3)), np.empty((0, 6)))


def _given(poses: np.ndarray, config: Config = CONFIG) -> GivenOdometry:
    return GivenOdometry(replace(round_drive()[1], T_world_lidar=poses), config.odometry)


def _checked(poses: np.ndarray, config: Config = CONFIG) -> CheckedOdometry:
    return CheckedOdometry(_given(poses, config), config, recover=partial(register, config=config))


def _checked_kiss() -> CheckedOdometry:
    return CheckedOdometry(KissOdometry(CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))


def _proposed(scan: SeenScan, T_odom_lidar: np.ndarray, gap: float = 1.0) -> Proposed:
    """A scan with the same pose by the odometry and by the last motions."""
    raw = Scan(scan.points, 0, 0)
    result = OdometryResult(T_odom_lidar, scan.points, unlabelled(len(scan.points)))
    return Proposed(raw, result, scan, T_odom_lidar, T_odom_lidar, gap)


def _registered(odometry: CheckedOdometry, scans: Sequence[Scan]) -> list[OdometryResult]:
    return [odometry.register(scan) for scan in scans]


def _slipped(*, metres: float = 0.0, degrees: float = 0.0, at: int = SLIP_AT) -> np.ndarray:
    """True poses, all from one scan on moved along the drive and turned."""
    poses = round_drive()[1].T_world_lidar.copy()
    slip = poses[at - 1] @ geometry.transform(geometry.yaw(np.radians(degrees)), [metres, 0.0, 0.0])
    poses[at:] = slip @ geometry.inverse(poses[at - 1]) @ poses[at:]
    return poses


def _worst_step_m(results: Sequence[OdometryResult]) -> float:
    truth = round_drive()[1].T_world_lidar
    steps = [
        geometry.distance(
            geometry.inverse(geometry.inverse(truth[k - 1]) @ truth[k])
            @ geometry.inverse(results[k - 1].T_odom_lidar)
            @ results[k].T_odom_lidar
        )
        for k in range(1, len(results))
    ]
    return max(steps)


def test_a_sound_odometry_is_left_as_it_is() -> None:
    scans, truth = round_drive()
    results = _registered(_checked(truth.T_world_lidar), scans[:40])
    plain = [result.T_odom_lidar for result in map(_given(truth.T_world_lidar).register, scans[:40])]
    np.testing.assert_array_equal([result.T_odom_lidar for result in results], plain)
    states = {result.motion.state for result in results if result.motion}
    assert states <= {MotionState.UNCHECKED, MotionState.CONFIRMED}
    assert MotionState.CONFIRMED in states


@pytest.mark.parametrize(
    ("metres", "degrees"),
    [(3.0, 0.0), (0.0, 40.0), *(pytest.param(*one, marks=pytest.mark.slow) for one in ((-1.0, 0.0), (0.4, 3.0)))],
)
def test_a_jump_of_the_odometry_is_repaired(metres: float, degrees: float) -> None:
    scans, _ = round_drive()
    results = _registered(_checked(_slipped(metres=metres, degrees=degrees)), scans[: SLIP_AT + 10])
    motion = results[SLIP_AT].motion
    assert motion is not None
    assert motion.state is MotionState.REPAIRED
    assert motion.moved_m is not None
    assert motion.moved_deg is not None
    along_m = 2 * np.sin(np.radians(degrees) / 2) * STEP_M  # a turn before the step moves its end
    assert motion.moved_m == pytest.approx(np.hypot(metres, along_m), abs=0.1)
    assert motion.moved_deg == pytest.approx(degrees, abs=0.5)
    assert _worst_step_m(results) < 0.06


class _LikeKiss(GivenOdometry):
    """Poses that are given, as if they came from the scans."""

    is_from_scans = True


@pytest.mark.parametrize("metres", [-2.5, pytest.param(-STEP_M, marks=pytest.mark.slow), 0.0])
def test_a_wrong_first_motion_is_repaired_and_a_right_one_is_kept(metres: float) -> None:
    scans, truth = round_drive()
    trajectory = replace(truth, T_world_lidar=_slipped(metres=metres, at=1))
    odometry = CheckedOdometry(_LikeKiss(trajectory, CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))
    results = _registered(odometry, scans[:3])
    motion = results[1].motion
    assert motion is not None
    assert (motion.state is MotionState.REPAIRED) == (metres != 0.0)
    assert _worst_step_m(results[:2]) < 0.06


@pytest.mark.long
def test_a_slow_sensor_does_not_lag_behind_as_its_odometry_does() -> None:
    """KISS-ICP lags in corridors at the pace of a robot, by less a scan than any single scan can show."""
    num, step_m = WINDOW + 40, 0.03
    scan = round_drive()[0][0]
    poses = np.array([geometry.transform(np.eye(3), [step_m * row, 0.0, 0.0]) for row in range(num)])
    scans = [
        replace(scan, points=geometry.apply(geometry.inverse(pose), scan.points).astype(np.float32), index=row)
        for row, pose in enumerate(poses)
    ]
    lagging = poses.copy()
    lagging[:, 0, 3] *= 0.7
    trajectory = Trajectory(np.arange(num), np.arange(num) * 100_000_000, lagging)
    odometry = CheckedOdometry(_LikeKiss(trajectory, CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))
    off_m = poses[-1, 0, 3] - _registered(odometry, scans)[-1].T_odom_lidar[0, 3]
    assert off_m == pytest.approx(0.0, abs=0.05)


def test_small_corrections_do_not_disturb_an_odometry_and_add_up() -> None:
    """An odometry that drifts sideways by 5 cm a scan continues in its own frame, each motion corrected."""

    class Drifting(_LikeKiss):
        def follow(self, *_: object, **__: object) -> None:
            raise AssertionError("a correction below the tolerance disturbs the odometry")

    scans, truth = round_drive()
    poses = truth.T_world_lidar.copy()
    aside = geometry.transform(np.eye(3), [0.0, 0.05, 0.0])
    for k in range(1, len(poses)):
        poses[k] = poses[k - 1] @ geometry.inverse(truth.T_world_lidar[k - 1]) @ truth.T_world_lidar[k] @ aside
    inner = Drifting(replace(truth, T_world_lidar=poses), CONFIG.odometry)
    odometry = CheckedOdometry(inner, CONFIG, recover=partial(register, config=CONFIG))
    results = _registered(odometry, scans[:25])
    assert [result.motion.state for result in results if result.motion].count(MotionState.REFINED) > 15
    assert _worst_step_m(results) < 0.05
    T_true = geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[24]
    assert geometry.distance(geometry.inverse(T_true) @ results[24].T_odom_lidar) < 0.2


def test_a_tracked_scan_has_the_result_of_its_check() -> None:
    scans, truth = round_drive()
    tracker = Tracker(CONFIG, odometry=_LikeKiss(truth, CONFIG.odometry))
    states = [tracker.track(scan).motion.state for scan in scans[:4]]
    assert MotionState.UNCHECKED not in states[1:]


def test_without_the_check_a_jump_remains() -> None:
    config = load_config(None, ["health.check=false"])
    results = _registered(_checked(_slipped(metres=3.0), config), round_drive()[0][: SLIP_AT + 2])
    assert _worst_step_m(results) == pytest.approx(3.0, abs=0.01)
    assert results[-1].motion is None


@pytest.mark.slow
def test_scans_that_are_missing_do_not_break_a_drive() -> None:
    scans, truth = round_drive()
    kept = [*scans[:20], *scans[23:40]]  # three scans, 9 m of the drive
    slam = Slam(CONFIG, odometry=KissOdometry(CONFIG.odometry))
    for scan in kept:
        slam.process(scan)
    result = slam.finish()
    assert not any(motion.is_break for motion in result.motions)
    found = trajectory_metrics(result.trajectory.T_world_lidar, truth.T_world_lidar[[scan.index for scan in kept]])
    assert found["ate_m"] < 0.15


def _elsewhere(scan: Scan) -> Scan:
    """The same scan as if nothing of what was seen before stood here: its points in a heap of another shape."""
    rng = np.random.default_rng(scan.index)
    points = rng.uniform([-40, -40, -2], [40, 40, 6], size=(20_000, 3))
    return replace(scan, points=points.astype(np.float32), labels=np.zeros(20_000, np.uint8))


def test_a_map_before_a_break_is_left_for_one_that_explains_the_scans_better() -> None:
    """Scans with every tenth point, six metres apart, the first of which shows another place."""
    scans, truth = round_drive()
    rows = range(1, 30, 3)
    thinned = [replace(scans[row], points=scans[row].points[::10], labels=scans[row].labels[::10]) for row in rows]
    first = replace(_elsewhere(scans[0]), points=_elsewhere(scans[0]).points[::10], labels=np.zeros(2000, np.uint8))
    odometry = CheckedOdometry(
        KissOdometry(CONFIG.odometry), CONFIG, recover=lambda *_: Rejected(RejectReason.SMALL_CLIQUE)
    )
    found = _registered(odometry, [first, *(replace(scan, stamp_ns=k * 10**8) for k, scan in enumerate(thinned, 1))])[
        1:
    ]
    for (a, b), (one, other) in zip(pairwise(rows), pairwise(found), strict=True):
        T_true = geometry.inverse(truth.T_world_lidar[a]) @ truth.T_world_lidar[b]
        T_found = geometry.inverse(one.T_odom_lidar) @ other.T_odom_lidar
        assert a == 1 or geometry.distance(geometry.inverse(T_true) @ T_found) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("interval_s", [0.3, 6.0])
def test_a_scan_from_another_town_is_a_break_though_the_odometry_is_steady(interval_s: float) -> None:
    scans, _ = round_drive()
    odometry = _checked_kiss()
    before = _registered(odometry, scans[:20])
    sweeps = round_sweeps(seed=13, only=range(20, 22))
    since_ns = scans[19].stamp_ns + int(interval_s * 1e9)
    others = [Scan(one.points, since_ns + k * 300_000_000, 20 + k, one.labels) for k, one in enumerate(sweeps)]
    results = _registered(odometry, others)
    states = [result.motion.state for result in results if result.motion]
    assert states[0] is MotionState.BROKEN
    assert states[1] in (MotionState.REFINED, MotionState.REPAIRED)
    truth = round_drive()[1].T_world_lidar
    T_there = geometry.inverse(results[0].T_odom_lidar) @ results[1].T_odom_lidar
    assert geometry.distance(geometry.inverse(truth[20]) @ truth[21] @ geometry.inverse(T_there)) < 0.05
    T_break = geometry.inverse(before[-1].T_odom_lidar) @ results[0].T_odom_lidar
    assert np.degrees(geometry.angle(T_break)) < 60.0, "the turn, 7 degrees a scan, ends in the gap of 20 scans"


def test_a_long_pause_before_the_second_scan_does_not_set_the_usual_interval() -> None:
    intervals = Intervals()
    gaps = []
    for stamp_s in [0.0, 6.0, 6.1, 6.2, 6.3, 6.4, 7.4, 7.5]:
        gaps.append(intervals.gap(int(stamp_s * 1e9)))
        intervals.note(int(stamp_s * 1e9))
    np.testing.assert_allclose(gaps, [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 10.0, 1.0], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("is_given", [True, False])
def test_a_scan_that_nothing_explains_is_no_evidence_against_the_drive(is_given: bool) -> None:
    scans, truth = round_drive()
    given = [*scans[:20], _elsewhere(scans[20]), *scans[21:26]]
    odometry = _checked(truth.T_world_lidar)
    if not is_given:
        odometry = _checked_kiss()
    results = _registered(odometry, given)
    states = [result.motion.state for result in results if result.motion]
    assert states[20] is (MotionState.UNCHECKED if is_given else MotionState.BROKEN)
    T_found = geometry.inverse(results[19].T_odom_lidar) @ results[22].T_odom_lidar
    T_true = geometry.inverse(truth.T_world_lidar[19]) @ truth.T_world_lidar[22]
    assert geometry.distance(geometry.inverse(T_true) @ T_found) < 0.1


@pytest.mark.slow
def test_a_sparse_first_scan_does_not_end_the_checks_of_a_drive() -> None:
    scans, _ = round_drive()
    thin = replace(scans[0], points=scans[0].points[::700], labels=scans[0].labels[::700])
    results = _registered(_checked(_slipped(metres=3.0)), [thin, *scans[1:40]])
    assert MotionState.REPAIRED in {result.motion.state for result in results if result.motion}
    assert _worst_step_m(results[1:]) < 0.2


@pytest.mark.parametrize(("probability", "is_kept"), [(0.1, True), (0.6, False)])
def test_the_local_map_is_given_up_where_a_scan_is_more_probably_elsewhere(
    probability: float, is_kept: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    scans, truth = round_drive()
    none = Rejected(RejectReason.HIGH_RESIDUAL)
    odometry = CheckedOdometry(_LikeKiss(truth, CONFIG.odometry), CONFIG, recover=lambda source, target: none)
    _registered(odometry, scans[:SLIP_AT])
    monkeypatch.setattr(odometry._scans, "_is_usual", lambda fits: False)
    monkeypatch.setattr(PoseSearch, "elsewhere", lambda search, fits: probability)
    motion = odometry.register(scans[SLIP_AT]).motion
    assert motion is not None
    assert motion.state is MotionState.BROKEN
    assert (len(odometry._scans.local) > 1) is is_kept


def test_scans_of_a_few_points_move_on_as_before_though_the_odometry_aligns_them_elsewhere() -> None:
    scans, truth = round_drive()
    few = [replace(scan, points=scan.points[::700], labels=scan.labels[::700]) for scan in scans[SLIP_AT : SLIP_AT + 4]]
    trajectory = replace(truth, T_world_lidar=_slipped(metres=2.0, degrees=60.0))
    odometry = CheckedOdometry(_LikeKiss(trajectory, CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))
    results = _registered(odometry, [*scans[:SLIP_AT], *few, *scans[SLIP_AT + 4 : SLIP_AT + 8]])
    assert _worst_step_m(results) < 0.25
    motions = [result.motion for result in results[SLIP_AT - 1 : SLIP_AT + 4] if result.motion]
    assert motions[1].state is MotionState.REPAIRED
    unsure_m = [np.sqrt(motion.covariance[3:, 3:].trace()) for motion in motions if motion.covariance is not None]
    assert len(unsure_m) == 5
    assert (np.diff(unsure_m) > 0.0).all(), "each motion adds to what is not known of the last"


@pytest.mark.parametrize("degrees", [-25.0, pytest.param(32.0, marks=pytest.mark.slow)])
def test_a_sudden_turn_is_found_by_the_search_around_the_last_pose(degrees: float) -> None:
    """Both the odometry and its prediction miss the turn, and no registration without initial guess is accepted."""
    scans, truth = round_drive()
    turn = geometry.transform(geometry.yaw(np.radians(degrees)), np.zeros(3))
    turned = replace(scans[SLIP_AT], points=geometry.apply(geometry.inverse(turn), scans[SLIP_AT].points))
    none = Rejected(RejectReason.HIGH_RESIDUAL)
    odometry = CheckedOdometry(_given(truth.T_world_lidar), CONFIG, recover=lambda source, target: none)
    results = _registered(odometry, [*scans[:SLIP_AT], turned])
    motion = results[-1].motion
    assert motion is not None
    assert motion.state is MotionState.REPAIRED
    before, now = truth.T_world_lidar[SLIP_AT - 1 : SLIP_AT + 1]
    T_before_found = geometry.inverse(results[-2].T_odom_lidar) @ results[-1].T_odom_lidar
    T_true_found = geometry.inverse(now @ turn) @ before @ T_before_found
    assert geometry.distance(T_true_found) < 0.1
    assert np.degrees(geometry.angle(T_true_found)) < 0.3


def test_a_turn_that_no_search_reaches_is_recognised_where_the_found_pose_contradicts_the_last_motions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also if no other pose is nearly as likely."""
    monkeypatch.setattr(PoseSearch, "elsewhere", lambda search, fits: 0.0)
    scans, truth = round_drive()
    turn = geometry.transform(geometry.yaw(np.radians(90.0)), np.zeros(3))
    turned = replace(scans[SLIP_AT], points=geometry.apply(geometry.inverse(turn), scans[SLIP_AT].points))
    odometry = CheckedOdometry(_LikeKiss(truth, CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))
    results = _registered(odometry, [*scans[:SLIP_AT], turned])
    before, now = truth.T_world_lidar[SLIP_AT - 1 : SLIP_AT + 1]
    T_before_found = geometry.inverse(results[-2].T_odom_lidar) @ results[-1].T_odom_lidar
    T_true_found = geometry.inverse(now @ turn) @ before @ T_before_found
    assert geometry.distance(T_true_found) < 0.1
    assert np.degrees(geometry.angle(T_true_found)) < 0.3


@pytest.mark.long
def test_points_are_moved_by_the_motion_during_their_sweep_not_by_that_before() -> None:
    """A sensor that is carried swings by 28 degrees to both sides, and 6 degrees about the other axes, in 1.6 s."""
    rows = range(1, 23)
    results = _registered(_checked_kiss(), [_carried(row) for row in rows])
    errors = []
    for (a, b), (before, after) in zip(pairwise(rows), pairwise(results), strict=True):
        T_true = geometry.inverse(_pose_carried(a - 0.75)) @ _pose_carried(b - 0.75)
        T_found = geometry.inverse(before.T_odom_lidar) @ after.T_odom_lidar
        T_error = geometry.inverse(T_true) @ T_found
        errors.append((geometry.distance(T_error), np.degrees(geometry.angle(T_error))))
    mean_m, mean_deg = np.mean(errors[8:], axis=0)  # a sensor that moves from the start is registered wrongly at first
    assert mean_m < 0.05
    assert mean_deg < 0.3


class _Foreseeing(GivenOdometry):
    """With the times of the points of the last scan that was foreseen."""

    foreseen = np.empty(0)

    def foresee(self, scan: Scan, *, gap: float) -> None:
        self.foreseen = scan.times


@pytest.mark.parametrize("stamp_time", [0.0, 1.0])
@pytest.mark.parametrize("step", [1, 2, 5])
def test_where_scans_are_left_out_points_are_moved_by_the_motion_during_their_sweep_alone(
    step: int, stamp_time: float
) -> None:
    """A sensor that moves 2 m in each sweep of 0.1 s, and every n-th of its scans."""
    rows = np.arange(0, 10 * step, step)
    truth = np.array([geometry.transform(np.eye(3), [2.0 * row, 0.0, 0.0]) for row in rows])
    world = np.random.default_rng(5).uniform(-30.0, 30.0, (50, 3)) + truth[:, None, :3, 3]
    times = np.linspace(0.0, 1.0, 50)
    scans = []
    for row, points in zip(rows, world, strict=True):
        measured_m = points - np.column_stack([2.0 * (row - stamp_time + times), np.zeros((50, 2))])
        scans.append(Scan(measured_m, 10**8 * int(row), int(row), times=times, sweep_s=0.1, stamp_time=stamp_time))
    inner = _Foreseeing(Trajectory(rows, 10**8 * rows, truth), CONFIG.odometry)
    odometry = CheckedOdometry(
        inner, load_config(None, ["health.check=false"]), recover=partial(register, config=CONFIG)
    )
    for k, ahead in enumerate([*scans[1:], None]):
        result = odometry.register(scans[k], ahead=ahead)
        if k > 0:
            np.testing.assert_allclose(result.points, world[k] - truth[k, :3, 3], atol=1e-4)
        if ahead is not None:
            np.testing.assert_allclose(inner.foreseen, 1.0 - (1.0 - times) / step)


def _pose_carried(scan: float) -> np.ndarray:
    """Pose of a sensor that swings while it moves along the drive, at a time in scans."""
    along = 0.5 * STEP_M * scan / RADIUS_M
    at = geometry.transform(geometry.yaw(along), [RADIUS_M * np.sin(along), -RADIUS_M * np.cos(along), 1.73])
    swing = [0.1 * np.sin(0.5 * scan), 0.1 * np.sin(0.45 * scan + 1.0), 0.5 * np.sin(0.4 * scan)]
    return at @ geometry.exp(geometry.tangent(rotation_rad=swing, translation_m=0.0))


def _carried(row: int) -> Scan:
    """A scan as such a sensor measures it in a sweep, with the times of its points."""
    scans, truth = round_drive()
    near = row // 2
    world = geometry.apply(truth.T_world_lidar[near], scans[near].points.astype(np.float64))
    at_end = geometry.apply(geometry.inverse(_pose_carried(row)), world)
    times = (np.arctan2(at_end[:, 1], at_end[:, 0]) / (2.0 * np.pi) + 0.5).round(2)
    points = at_end.copy()
    for time in np.unique(times):
        T_lidar_world = geometry.inverse(_pose_carried(row - 1.0 + time))
        points[times == time] = geometry.apply(T_lidar_world, world[times == time])
    return Scan(points, 10**8 * row, row, times=times, stamp_time=0.25)


def test_of_two_poses_that_explain_a_scan_nearly_as_well_the_usual_motion_is_more_likely() -> None:
    model = MotionModel()
    step = geometry.transform(np.eye(3), [1.0, 0.0, 0.0])
    exact = 1e-6 * np.eye(6)
    assert model.log_prior(step, exact, 1.0) == 0.0, "nothing is known yet"
    rng = np.random.default_rng(5)
    for _ in range(20):
        model.update(step @ geometry.exp(0.02 * rng.standard_normal(6)), exact, 1.0)
    turned = step @ geometry.exp(np.radians(70.0) * np.eye(6)[2])
    assert model.log_prior(step, exact, 1.0) == 0.0
    assert -8.0 < model.log_prior(turned, exact, 1.0) < -4.0, "large changes are rare, not impossible"
    fits = [
        Fit(pose, mean_log, 100, 0.5, 0.1, np.eye(6), NO_ERRORS, model.log_prior(pose, exact, 1.0))
        for pose, mean_log in ((turned, -2.44), (step, -2.47), (turned, -1.4))
    ]
    assert as_likely(fits[1], fits[0]) == 1.0, "the usual motion is more likely"
    assert as_likely(fits[1], fits[2]) < 0.01, "unless the scan shows the turn"


@pytest.mark.parametrize(("side_m", "num_points", "share"), [(4.0, 20_000, 0.5), (4.0, 100, 1.0), (40.0, 20_000, 1.0)])
def test_the_voxels_of_a_drive_are_half_as_large_if_its_first_scan_sees_little_and_that_densely(
    side_m: float, num_points: int, share: float
) -> None:
    rng = np.random.default_rng(0)
    floors = [rng.uniform(-0.5, 0.5, (num_points, 3)) * [side_m, side_m, 0.0] + [0.0, 0.0, z] for z in (-1.0, 1.5)]
    scans = ScanToMap(CONFIG, recover=lambda *_: Rejected(RejectReason.SMALL_CLIQUE))
    first = scans.seen(np.vstack(floors).astype(np.float32))
    other = scans.seen((np.vstack(floors) * [44.0 / side_m, 44.0 / side_m, 1.0]).astype(np.float32))
    assert scans.local.voxel_m == share * CONFIG.refine.voxel_m
    for scan in (first, other):
        downsampled = refinement.downsample(
            scan.points, config=CONFIG.refine.model_copy(update={"voxel_m": scans.local.voxel_m})
        )
        assert np.array_equal(scan.thinned, downsampled)


@pytest.mark.parametrize("shared_m", [0.0, 0.05])
def test_the_covariance_of_a_pose_is_that_of_its_errors_whether_or_not_points_share_theirs(shared_m: float) -> None:
    """Each wall of a room errs by 2 cm a point, and by `shared_m` in each patch of 2 m."""
    config, rng = CONFIG.refine, np.random.default_rng(0)
    grid = np.mgrid[-10.0:10.0:41j, -10.0:10.0:41j].reshape(2, -1).T + 0.013
    axes = [0, 1, 2, 0, 1, 2]
    sides = [np.insert(grid, axis, at_m, axis=1) for axis, at_m in zip(axes, [-10, -10, -2, 10, 10, 6], strict=True)]
    walls = np.vstack([side[(side[:, 2] >= -2.0) & (side[:, 2] <= 6.0)] for side in sides])
    normals = np.repeat(np.eye(3)[axes], [len(side[(side[:, 2] >= -2.0) & (side[:, 2] <= 6.0)]) for side in sides], 0)
    _, patch = np.unique(np.column_stack([walls // 2.0, normals]), axis=0, return_inverse=True)
    surface, correlation, squares = LightSurface(walls), Correlation(WINDOW), []
    for _ in range(60):
        off_m = 0.02 * rng.standard_normal(len(walls)) + shared_m * rng.standard_normal(patch.max() + 1)[patch.ravel()]
        points = (walls + off_m[:, None] * normals).astype(np.float32)
        moved = nudge(points, surface, np.eye(4), voxel_m=config.voxel_m, reaches=POLISH_VOXELS)
        assert moved is not None
        found = fit(points, surface, moved, correlation, voxel_m=config.voxel_m, sigma_m=0.05)
        correlation.note(found)
        error = geometry.log(moved)
        squares.append(float(error @ found.information @ error))
    assert 0.6 < np.mean(squares) / 6.0 < 1.6


def test_the_covariance_of_a_motion_is_at_least_its_own_whatever_the_errors_before_were() -> None:
    """Where a scan shows the position again that scans before did not show, errors cancel each other."""
    rng = np.random.default_rng(3)
    model = MotionModel()
    for count in range(200):
        step = geometry.exp(0.3 * rng.standard_normal(6))
        is_hidden = rng.random(6) < 0.3 * (count > 20)
        axes = geometry.exp(rng.standard_normal(6))[:3, :3]
        turned = np.kron(np.eye(2), axes)
        measured = turned @ np.diag(np.where(is_hidden, 100.0, 1e-4)) @ turned.T
        own = model.fused(step, measured, 1.0)[1]
        _, covariance = model.update(step, measured, 1.0)
        assert np.linalg.eigvalsh(covariance - own).min() > -1e-9 * np.linalg.eigvalsh(covariance).max()


def test_what_scans_did_not_show_is_turned_with_the_sensor_once() -> None:
    """A quarter turn, after which the direction ahead is unseen."""
    model = MotionModel()
    for sign in (1.0, -1.0) * 4:
        model.update(geometry.transform(geometry.yaw(0.3), [1.0, 0.01 * sign, 0.0]), 1e-6 * np.eye(6), 1.0)
    measured = np.diag(geometry.tangent(rotation_rad=1e-6, translation_m=[900.0, 1e-6, 1e-6]))
    _, covariance = model.update(geometry.transform(geometry.yaw(np.pi / 2), [1.0, 0.0, 0.0]), measured, 1.0)
    assert covariance[3, 3] > 100.0 * covariance[4, 4]
    assert model._unseen[-1][3, 3] > 100.0 * model._unseen[-1][4, 4]


@pytest.mark.parametrize("num_shared", [0, 1, 2, 5])
def test_a_scan_that_shares_a_few_points_with_the_map_is_a_break(num_shared: int) -> None:
    rng = np.random.default_rng(num_shared)
    street = rng.uniform(-25.0, 25.0, (2500, 3))
    street[:800, 2] = -1.7
    street[800:1600, 1] = np.where(rng.random(800) < 0.5, 8.0, -8.0)
    azimuth, range_m = rng.uniform(0.0, 2.0 * np.pi, 400), rng.uniform(40.0, 58.0, 400)
    far = np.column_stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), rng.uniform(5.0, 25.0, 400)])
    slam = Slam(Config())
    slam.process(Scan(street.astype(np.float32), 0))
    motion = slam.process(Scan(np.vstack([far, street[:num_shared]]).astype(np.float32), 100_000_000)).motion
    assert motion is not None
    assert motion.state is MotionState.BROKEN


@pytest.mark.parametrize("voxel_m", [0.5, 0.1])
def test_a_pose_at_which_one_point_meets_the_map_has_an_information(voxel_m: float) -> None:
    rng = np.random.default_rng(0)
    config = CONFIG.refine.model_copy(update={"voxel_m": voxel_m})
    level = rng.uniform(-55.0, 55.0, (3000, 2))
    scan = SeenScan(np.column_stack([level, np.full(3000, -1.7)]).astype(np.float32), config)
    local = LocalMap(config, Correlation(WINDOW))
    local.add(np.eye(4), scan)
    points = scan.surface.points
    far = points[np.linalg.norm(points, axis=1) > 40.0]
    for _ in range(40):
        here, there = far[rng.integers(len(far), size=2)]
        R = geometry.exp(geometry.tangent(rotation_rad=0.5 * rng.standard_normal(3), translation_m=0.0))[:3, :3]
        information = local.fit(scan, geometry.transform(R, there - R @ here)).information
        assert np.linalg.eigvalsh(information).max() > 0.0


@pytest.mark.data
@pytest.mark.parametrize(("row", "fits_best"), [(29, False), (53, True), (54, False)])
def test_a_narrow_view_of_new_surroundings_does_not_slide_back_along_a_wall(
    data_dir: Path, row: int, fits_best: bool
) -> None:
    """Two scans overlap the map most at a pose metres off, where their points fit better on average."""
    drive = open_dataset(data_dir / "courtyard")
    assert drive.reference is not None
    poses = drive.reference.T_world_lidar

    def seen(index: int) -> SeenScan:
        points = drive[index].points
        is_ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) < np.radians(35.0)
        return SeenScan(points[is_ahead], CONFIG.refine)

    local, scan = LocalMap(CONFIG.refine, Correlation(WINDOW)), seen(row)
    for index in range(row):
        local.add(poses[index], seen(index))
    T_map_last, T_map_lidar = (geometry.inverse(local.T_odom_map) @ poses[index] for index in (row - 1, row))
    step = geometry.inverse(poses[row - 2]) @ poses[row - 1]
    search = PoseSearch(local, scan)
    near = search.near([T_map_last @ step, T_map_last])
    found = search.around(T_map_last, step, near)
    assert geometry.distance(geometry.inverse(T_map_lidar) @ found[0].T_map_lidar) < 0.3
    assert (max(found, key=lambda fit: fit.mean_log) is found[0]) is fits_best, "by the likelihood alone"


def test_a_pose_at_which_no_point_is_near_the_map_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A map of one plane constrains no step along it: steps of hundreds of metres were seen in real scans."""
    local = LocalMap(CONFIG.refine, Correlation(WINDOW))
    scan = SeenScan(round_drive()[0][0].points, CONFIG.refine)
    local.add(np.eye(4), scan)
    assert local.approach(scan, np.eye(4)) is not None
    far = geometry.transform(np.eye(3), [180.0, 0.0, 0.0])
    monkeypatch.setattr(local_map, "nudge", lambda *_, **__: far)
    assert local.register(scan, np.eye(4)) == []
    assert local.approach(scan, np.eye(4)) is None


def test_points_on_the_borders_of_voxels_are_in_the_same_ones_for_poses_that_differ_by_rounding() -> None:
    points = (np.random.default_rng(0).integers(-40, 40, (2000, 3)) * CONFIG.refine.voxel_m).astype(np.float32)

    def made(*, moved_m: float) -> np.ndarray:
        local = LocalMap(CONFIG.refine, Correlation(WINDOW))
        for x_m in (0.0, 1.03):
            pose = geometry.exp(np.array([0.1, 0.2, 1.0, 2.0 + x_m + moved_m, 3.0, 0.1]))
            local.add(pose, SeenScan(points, CONFIG.refine))
        return local.surface().points

    np.testing.assert_allclose(made(moved_m=1e-13), made(moved_m=0.0), atol=1e-5)


def test_poses_that_no_score_brings_among_the_first_are_not_scored(monkeypatch: pytest.MonkeyPatch) -> None:
    scans, truth = round_drive()
    local = LocalMap(CONFIG.refine, Correlation(WINDOW))
    local.add(truth.T_world_lidar[0], SeenScan(scans[0].points, CONFIG.refine))
    scan = SeenScan(scans[1].points, CONFIG.refine)
    search = PoseSearch(local, scan)
    apart = [geometry.transform(geometry.yaw(turn), [0.0, 0.0, 0.0]) for turn in np.radians([0.0, 90.0, 180.0, 270.0])]
    fits = [local.fit(scan, T_map_lidar) for T_map_lidar in apart]
    likely = [replace(fit, mean_log=0.001 * number) for number, fit in enumerate(fits)]
    far = [replace(fit, T_map_lidar=fit.T_map_lidar @ geometry.transform(np.eye(3), [9.0, 0.0, 0.0])) for fit in fits]
    unlikely = [replace(fit, mean_log=-9.0) for fit in far]
    scored: list[np.ndarray] = []
    odds = {
        id(fit.T_map_lidar): value
        for fit, value in zip([*likely, *unlikely], (1.0, 3.0, 2.0, 0.0, *[30.0] * 4), strict=True)
    }

    def scored_by(search: PoseSearch, fit: Fit) -> float:
        scored.append(fit.T_map_lidar)
        return odds[id(fit.T_map_lidar)]

    monkeypatch.setattr(PoseSearch, "log_odds", scored_by)
    order = search._compared([*unlikely, *likely], num_ordered=3)
    assert [id(fit.T_map_lidar) for fit in order[:4]] == [id(likely[number].T_map_lidar) for number in (1, 2, 0, 3)]
    assert len(order) == 8
    assert len(scored) == 4


@pytest.mark.parametrize(("log_odds", "is_searched"), [(20.0, False), (1.0, True)])
def test_a_scan_of_an_unusual_fit_is_searched_around_unless_its_score_is_good(
    monkeypatch: pytest.MonkeyPatch, log_odds: float, is_searched: bool
) -> None:
    scans, truth = round_drive()
    odometry = _checked(truth.T_world_lidar)
    _registered(odometry, scans[:SLIP_AT])
    searched: list[object] = []
    monkeypatch.setattr(odometry._scans, "_is_usual", lambda fits: False)
    monkeypatch.setattr(PoseSearch, "log_odds", lambda *_: log_odds)
    monkeypatch.setattr(PoseSearch, "around", lambda search, *_: searched.append(search) or [])
    T_odom_lidar = geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[SLIP_AT]
    seen = SeenScan(scans[SLIP_AT].points, CONFIG.refine)
    odometry._scans._poses(_proposed(seen, T_odom_lidar))
    assert bool(searched) is is_searched


def test_a_fit_below_the_last_ones_is_searched_around(monkeypatch: pytest.MonkeyPatch) -> None:
    scans, truth = round_drive()
    odometry = _checked(truth.T_world_lidar)
    _registered(odometry, scans[:SLIP_AT])
    T_odom_lidar = geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[SLIP_AT]
    seen = SeenScan(scans[SLIP_AT].points, CONFIG.refine)
    found = odometry._scans.local.fit(seen, geometry.inverse(odometry._scans.local.T_odom_map) @ T_odom_lidar)
    odometry._scans._last_fits.clear()
    odometry._scans._last_fits.append(found.mean_log + 1.0)
    searched: list[object] = []
    monkeypatch.setattr(PoseSearch, "log_odds", lambda *_: 1.0)
    monkeypatch.setattr(PoseSearch, "around", lambda search, *_: searched.append(search) or [])
    odometry._scans._poses(_proposed(seen, T_odom_lidar))
    assert len(searched) == 1


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_scan_that_no_proposal_explains_is_tried_with_turns_about_each_axis(axis: int) -> None:
    starts: list[np.ndarray] = []

    class Nothing(LocalMap):
        def approach(self, scan: SeenScan, T_map_guess: np.ndarray) -> None:
            starts.append(T_map_guess)

    scan = SeenScan(np.zeros((1, 3), np.float32), CONFIG.refine)
    assert PoseSearch(Nothing(CONFIG.refine, Correlation(WINDOW)), scan).around(np.eye(4), np.eye(4), []) == []
    turned = geometry.exp(np.radians(-30.0) * np.eye(6)[axis])
    assert any(np.allclose(start, turned) for start in starts)


@pytest.mark.slow
def test_a_keyframe_follows_a_break_and_its_motion_has_nearly_no_information() -> None:
    scans, _ = round_drive()
    slam = Slam(CONFIG)
    steps = [slam.process(scan) for scan in [*scans[:20], _elsewhere(scans[20]), *scans[21:24]]]
    keyframe, before = steps[20].keyframe, steps[19].keyframe
    assert keyframe is not None
    assert before is not None
    assert keyframe.travel_m - before.travel_m < 100.0, "the length of the path, as it is logged"
    assert np.diff(slam.graph.num_breaks)[before.id] == 1
    assert np.diff(slam.graph.travel_m)[before.id] >= BREAK_LENGTH_M
    assert [step.motion.state for step in steps if step.motion][20] is MotionState.BROKEN


@pytest.mark.long
def test_a_registration_that_leads_away_from_its_start_is_compared_with_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends two metres beside the true pose, which explains the scan better, though both are as usual."""
    scans, truth = round_drive()
    odometry = _checked(_slipped(metres=3.0))
    last = _registered(odometry, scans[:SLIP_AT])[-1]
    usual = float(np.median(odometry._scans._last_fits))

    before, now = truth.T_world_lidar[SLIP_AT - 1 : SLIP_AT + 1]

    def slides(search: PoseSearch, starts: object, known: object = ()) -> list[Fit]:
        beside = geometry.inverse(before) @ now @ geometry.transform(np.eye(3), [0.0, 2.0, 0.0])
        fit = search.local.fit(search._scan, beside)
        return [replace(fit, mean_log=usual - 2.0 * fit.num_patches**-0.5)]

    monkeypatch.setattr(PoseSearch, "near", slides)
    found = odometry.register(scans[SLIP_AT])
    T_before_found = geometry.inverse(last.T_odom_lidar) @ found.T_odom_lidar
    assert geometry.distance(geometry.inverse(now) @ before @ T_before_found) < 0.1


def test_a_motion_is_unsure_by_the_distance_of_two_poses_that_explain_the_scan_as_usual(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scans, truth = round_drive()
    odometry = _checked(_slipped(metres=3.0))
    _registered(odometry, scans[:SLIP_AT])
    usual = float(np.median(odometry._scans._last_fits))
    T_before_now = geometry.inverse(truth.T_world_lidar[SLIP_AT - 1]) @ truth.T_world_lidar[SLIP_AT]

    def two(search: PoseSearch, starts: object, known: object = ()) -> list[Fit]:
        places = [T_before_now @ geometry.transform(np.eye(3), [0.0, left_m, 0.0]) for left_m in (0.0, 1.2)]
        fits = [search.local.fit(search._scan, T) for T in places]
        return [replace(fit, mean_log=usual, information=1e4 * np.eye(6)) for fit in fits]

    monkeypatch.setattr(PoseSearch, "near", two)
    motion = odometry.register(scans[SLIP_AT]).motion
    assert motion is not None
    assert motion.covariance is not None
    assert np.sqrt(np.diag(motion.covariance)[3:]) == pytest.approx([0.0, 1.2 / np.sqrt(2.0), 0.0], abs=0.1)


def _model_and_shared() -> tuple[np.ndarray, np.ndarray]:
    """Covariances (6, 6) of a motion by the graph's noise of odometry, and of the errors that all points share."""
    step = geometry.transform(np.eye(3), np.array([CONFIG.keyframes.distance_m, 0.0, 0.0]))
    shared = geometry.tangent(rotation_rad=np.radians(SHARED_NOISE_DEG), translation_m=SHARED_NOISE_M)
    return np.linalg.inv(odometry_information(0.0, step, CONFIG.graph)), np.diag(shared**2)


def test_a_motion_has_information_of_its_own_if_it_is_less_certain_than_the_model() -> None:
    model, shared = _model_and_shared()
    odometry = _checked(round_drive()[1].T_world_lidar)
    assert odometry._own_information(0.5 * (model + shared)) is None
    own = odometry._own_information(4.0 * (model + shared))
    assert own is not None
    np.testing.assert_allclose(own @ (4.0 * model + 3.0 * shared), np.eye(6), atol=1e-6)
    along = 0.5 * (model + shared) + np.diag([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])  # the scan shows all but one axis
    own = odometry._own_information(along)
    assert own is not None
    assert np.linalg.inv(own)[3, 3] == pytest.approx(1.0, rel=0.1)


def test_the_information_of_a_motion_has_no_jump_where_it_becomes_less_certain_than_the_model() -> None:
    """Errors that all points share are no part of it."""
    model, shared = _model_and_shared()
    odometry = _checked(round_drive()[1].T_world_lidar)
    own = odometry._own_information(1.001 * (model + shared))
    assert own is not None
    np.testing.assert_allclose(np.sqrt(np.diag(np.linalg.inv(own))), np.sqrt(np.diag(model)), rtol=0.01)


def test_a_motion_is_as_uncertain_in_each_direction_as_the_scan_or_the_model_whichever_is_more() -> None:
    """Directions in which both rotation and translation are uncertain: their variances relative to the usual ones."""
    model, shared = _model_and_shared()
    odometry = _checked(round_drive()[1].T_world_lidar)
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((6, 6)))[0]
    root = np.sqrt(model + shared) @ turn
    own = odometry._own_information(root @ np.diag([9.0, 4.0, 1.0, 0.5, 0.1, 0.01]) @ root.T)
    assert own is not None
    more = eigh(np.linalg.inv(own) - model, model + shared, eigvals_only=True)
    np.testing.assert_allclose(more, [0.0] * 4 + [3.0, 8.0], atol=1e-6)


def test_a_scan_that_shows_nothing_in_a_direction_is_as_unsure_there_as_one_that_nothing_explains() -> None:
    odometry = _checked(round_drive()[1].T_world_lidar)
    information = np.diag([0.0, 1e6, 1e6, 0.0, 1e6, 1e6])
    covariance = odometry._scans.covariance(Fit(np.eye(4), 0.0, 100, 1.0, 0.05, information, NO_ERRORS))
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(sigma[[0, 3]], [np.radians(60.0), 30.0], rtol=1e-3)
    assert (sigma[[1, 2, 4, 5]] < 0.04).all()


@pytest.mark.parametrize("num_points", [300, 20_000])
def test_how_far_two_poses_move_a_scan_is_seen_by_some_of_its_points(num_points: int) -> None:
    points = np.random.default_rng(0).normal(size=(num_points, 3)).astype(np.float32)
    T_a, T_b = (geometry.exp(np.array([0.1, -0.2, k, 1.0 + k, 2.0, -0.5])) for k in (0.3, 0.35))
    apart = geometry.apply(T_a, points) - geometry.apply(T_b, points)
    expected_m = np.sqrt(np.mean(np.sum(apart**2, axis=1)))
    moments = SeenScan(points, CONFIG.refine).moments
    assert geometry.displacement_m(moments, T_a, T_b) == pytest.approx(expected_m, rel=0.02)
    assert geometry.displacement_m(moments, T_a, T_a) == 0.0


def test_the_local_map_ends_where_no_scan_reaches() -> None:
    generator = np.random.default_rng(1)
    points = np.column_stack([generator.uniform(-55.0, 55.0, (4000, 2)), np.zeros(4000)]).astype(np.float32)
    local = LocalMap(CONFIG.refine, Correlation(WINDOW))
    for x_m in (0.0, 40.0):
        local.add(geometry.transform(np.eye(3), [x_m, 0.0, 0.0]), SeenScan(points, CONFIG.refine))
    far_m = np.linalg.norm(local.surface().points, axis=1)
    assert 55.0 < far_m.max() < 60.0
    assert local.surface().points[:, 0].min() < -58.0  # seen by the scan before


def test_a_cloud_that_is_taken_away_leaves_the_means_of_the_others() -> None:
    first, second = np.random.default_rng(2).uniform(-3.0, 3.0, (2, 500, 3)) + 1000.0
    both, one = Voxels(0.5), Voxels(0.5)
    both.add(first)
    both.add(second)
    one.add(second)
    assert len(both.means()) > len(one.means())
    both.take_away(first)
    np.testing.assert_allclose(both.means(), one.means(), atol=1e-9)
    cells = np.floor(second / 0.5 + 1.0 / 3.0)
    expected = [second[(cells == cell).all(axis=1)].mean(axis=0) for cell in np.unique(cells, axis=0)]
    np.testing.assert_allclose(one.means(), expected, atol=1e-9)


def test_a_given_motion_predicts_the_next_one() -> None:
    scans, truth = round_drive()
    odometry = _checked(truth.T_world_lidar)
    _registered(odometry, scans[:5])
    T_step = geometry.inverse(truth.T_world_lidar[3]) @ truth.T_world_lidar[4]
    np.testing.assert_allclose(odometry._motion.T_step, T_step, atol=1e-6)


def test_the_uncertainties_of_several_motions_add_up() -> None:
    motions = [Motion(MotionState.CONFIRMED)]
    motions += [Motion(MotionState.BROKEN, information=information * np.eye(6)) for information in (1.0, 0.25)]
    np.testing.assert_allclose(information_of(motions), np.eye(6) / 5.0)
    assert information_of(motions[:1]) is None


def test_too_few_points_are_not_checked() -> None:
    scans, truth = round_drive()
    thin = [replace(scan, points=scan.points[::700], labels=scan.labels[::700]) for scan in scans[:10]]
    results = _registered(_checked(truth.T_world_lidar), thin)
    assert {result.motion.state for result in results if result.motion} == {MotionState.UNCHECKED}


@pytest.mark.long
def test_recovery_without_initial_guess_runs_only_where_guesses_fail() -> None:
    asked = []

    def recover(source: np.ndarray, target: np.ndarray) -> Rejected:
        asked.append((len(source), len(target)))
        return Rejected(RejectReason.SMALL_CLIQUE)

    scans, truth = round_drive()
    odometry = CheckedOdometry(_given(truth.T_world_lidar), CONFIG, recover=recover)
    _registered(odometry, [*scans[:20], _elsewhere(scans[20])])
    assert len(asked) == 2, "at the first motion, and for the scan that nothing explains"


@pytest.mark.parametrize("moved_m", [0.1, 0.2])
def test_a_few_steps_correct_a_small_slip(moved_m: float) -> None:
    scans, truth = round_drive()
    seen = [SeenScan(scan.points, CONFIG.refine) for scan in scans[:2]]
    T_target_source = geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[1]
    slip = geometry.transform(np.eye(3), [moved_m, 0.0, 0.0])
    T_slipped = T_target_source @ slip
    target = LightSurface(seen[0].thinned)
    found = nudge(seen[1].thinned, target, T_slipped, voxel_m=CONFIG.refine.voxel_m, reaches=POLISH_VOXELS)
    assert found is not None
    assert geometry.distance(geometry.inverse(T_slipped) @ found) == pytest.approx(moved_m, abs=0.06)


@pytest.mark.long
def test_a_few_steps_suffice_only_if_those_from_the_last_motion_end_there_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever they begin there is a local optimum, which explains the scan as usual; so at the slipped pose, too."""

    def approach(local: LocalMap, scan: SeenScan, T_map_guess: np.ndarray, *, num_points: int = 0) -> Fit:
        return replace(local.fit(scan, T_map_guess), mean_log=10.0)

    monkeypatch.setattr(LocalMap, "approach", approach)
    scans, truth = round_drive()
    trajectory = replace(truth, T_world_lidar=_slipped(metres=2.0, at=WINDOW + 3))
    odometry = CheckedOdometry(_LikeKiss(trajectory, CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))
    results = _registered(odometry, scans[: WINDOW + 5])
    assert _worst_step_m(results) < 0.25


@pytest.mark.long
@pytest.mark.parametrize("num_again", [10, pytest.param(70, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "last", [pytest.param(15, marks=pytest.mark.slow), SLIP_AT + 1, pytest.param(SLIP_AT + 12, marks=pytest.mark.slow)]
)
def test_an_interrupted_drive_continues_from_its_last_scans(
    last: int, num_again: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("segslam.odometry.tracker.RESUMED_SCANS", num_again)
    scans, _ = round_drive()
    whole, resumed = (Tracker(CONFIG, odometry=_given(_slipped(metres=2.0))) for _ in range(2))
    head = [whole.track(scan) for scan in scans[: last + 1]]
    for one in head:
        resumed.note(Step(one.scan_index, one.stamp_ns, one.T_odom_lidar, None, (), None, {}, one.motion))
    poses, stamps_ns = (np.stack([getattr(one, name) for one in head]) for name in ("T_odom_lidar", "stamp_ns"))
    resumed.resume(poses, stamps_ns, lambda row: scans[row])
    for scan in scans[last + 1 : 36]:
        whole_now, resumed_now = whole.track(scan), resumed.track(scan)
        apart = geometry.inverse(whole_now.T_odom_lidar) @ resumed_now.T_odom_lidar
        assert geometry.distance(apart) < (0.1 if num_again < last else 1e-6)


def _behind_a_van(scan: Scan) -> np.ndarray:
    """What a sensor with 40 degrees of view sees behind a van that drives as fast as its own vehicle."""
    in_view = np.abs(np.arctan2(scan.points[:, 1], scan.points[:, 0])) < np.radians(20.0)
    sides = np.mgrid[9:15:0.25, -1:1.1:2, -1.5:1:0.25].reshape(3, -1).T
    back = np.mgrid[9:10, -1:1.1:0.25, -1.5:1:0.25].reshape(3, -1).T
    return np.vstack([scan.points[in_view], sides, back]).astype(np.float32)


def test_a_vehicle_that_drives_ahead_does_not_hold_a_registration_back() -> None:
    scans, truth = round_drive()
    local = LocalMap(CONFIG.refine, Correlation(WINDOW))
    for row in range(10):
        local.add(truth.T_world_lidar[row], SeenScan(_behind_a_van(scans[row]), CONFIG.refine))
    scan = SeenScan(_behind_a_van(scans[10]), CONFIG.refine)
    T_true = geometry.inverse(local.T_odom_map) @ truth.T_world_lidar[10]
    best = max(local.register(scan, T_true), key=lambda found: found.mean_log)
    error_m = geometry.distance(geometry.inverse(T_true) @ best.T_map_lidar)
    refine = CONFIG.refine.model_copy(update={"correspondence_m": (2.0, 0.7)})
    by_gicp = refined(scan.surface, local.surface(), T_true, config=refine, must_converge=False)
    assert isinstance(by_gicp, Registration)
    assert error_m < 0.7 * geometry.distance(geometry.inverse(T_true) @ by_gicp.T_target_source)


def test_kiss_icp_follows_a_repair() -> None:
    scans, truth = round_drive()
    odometry = KissOdometry(CONFIG.odometry)
    for scan in scans[:5]:
        odometry.register(scan)
    T_first = geometry.inverse(truth.T_world_lidar[0])
    placed = [(T_first @ truth.T_world_lidar[k], SeenScan(scans[k].points, CONFIG.refine).thinned) for k in range(5)]
    moved = geometry.transform(np.eye(3), [100.0, 0.0, 0.0])
    odometry.follow(
        [(moved @ T_odom_lidar, points) for T_odom_lidar, points in placed],
        moved @ placed[-1][0],
        geometry.inverse(placed[-2][0]) @ placed[-1][0],
    )
    expected = moved @ T_first @ truth.T_world_lidar[5]
    assert geometry.distance(geometry.inverse(expected) @ odometry.register(scans[5]).T_odom_lidar) < 0.1


def _tunnel_scan(index: int) -> Scan:
    """A smooth tube of 5 m radius along x, with a floor 1.7 m below the sensor."""
    rng = np.random.default_rng(index)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-180, 180, 0.5)), np.radians(np.arange(-24, 25, 2)))
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    rays = rays.reshape(-1, 3)
    to_tube = 5.0 / np.maximum(np.hypot(rays[:, 1], rays[:, 2]), 1e-9)
    to_floor = 1.7 / np.maximum(-rays[:, 2], 1e-9)
    ranges = np.minimum(to_tube, to_floor) + rng.normal(scale=0.01, size=len(rays))
    seen = ranges < 40.0
    return Scan((rays[seen] * ranges[seen, None]).astype(np.float32), stamp_ns=index * 100_000_000, index=index)


def _into_a_tunnel(num_scans: int = 40) -> list[Scan]:
    """The tunnel begins at scan 11, and the sensor continues as before."""
    street = [replace(scan, index=row, stamp_ns=row * 100_000_000) for row, scan in enumerate(round_drive()[0][:11])]
    return street + [_tunnel_scan(row) for row in range(11, num_scans)]


def test_points_on_a_plane_are_as_likely_as_nine_tenths_of_inliers_make_them() -> None:
    at_m = np.arange(0.25, 15.0, 0.5)
    wall = np.stack([*np.meshgrid(at_m, at_m), np.full((30, 30), 2.0)], axis=-1).reshape(-1, 3).astype(np.float32)
    found = fit(wall, LightSurface(wall), np.eye(4), Correlation(WINDOW), voxel_m=0.5, sigma_m=0.1)
    away = fit(wall + np.float32(30.0), LightSurface(wall), np.eye(4), Correlation(WINDOW), voxel_m=0.5, sigma_m=0.1)
    outlier = 0.1 / 2.0
    assert found.mean_log == pytest.approx(np.log(0.9 / (np.sqrt(2.0 * np.pi) * 0.1) + outlier), abs=1e-6)
    assert away.mean_log == pytest.approx(np.log(outlier), abs=1e-6)
    assert (found.overlap, away.overlap) == (1.0, 0.0)


def test_a_scan_of_a_smooth_tunnel_does_not_constrain_the_position_along_it() -> None:
    R = geometry.yaw(0.3)
    sigmas_m = []
    for points in ((_tunnel_scan(0).points @ R.T).astype(np.float32), round_drive()[0][0].points):
        scan = SeenScan(points, CONFIG.refine)
        found = fit(
            scan.thinned, LightSurface(scan.thinned), np.eye(4), Correlation(WINDOW), voxel_m=CONFIG.refine.voxel_m
        )
        covariance = np.linalg.inv(found.information)[3:, 3:]
        sigmas_m.append(np.sqrt(np.linalg.eigvalsh(covariance)))
        if len(sigmas_m) == 1:
            assert abs(np.linalg.eigh(covariance)[1][:, 2] @ R[:, 0]) > 0.999
    assert sigmas_m[0][2] > 5.0
    assert sigmas_m[0][1] < 0.1
    assert sigmas_m[1][2] < 0.1


@pytest.mark.slow
def test_in_a_smooth_tunnel_the_motion_along_it_is_reported_as_uncertain() -> None:
    odometry = _checked_kiss()
    results = _registered(odometry, _into_a_tunnel(20))
    covariances = [result.motion.covariance for result in results[13:] if result.motion is not None]
    sigmas_m = np.median([np.sqrt(np.diag(covariance))[3:] for covariance in covariances], axis=0)
    assert sigmas_m[0] > 4.0 * max(sigmas_m[1:])


@pytest.mark.slow
def test_a_given_odometry_is_kept_in_a_smooth_tunnel() -> None:
    poses = round_drive()[1].T_world_lidar[:40].copy()
    for row in range(11, 40):
        poses[row] = poses[row - 1] @ geometry.transform(np.eye(3), [STEP_M, 0.0, 0.0])
    scans = _into_a_tunnel()
    given = GivenOdometry(
        Trajectory(np.arange(40), np.array([scan.stamp_ns for scan in scans]), poses), CONFIG.odometry
    )
    results = _registered(CheckedOdometry(given, CONFIG, recover=partial(register, config=CONFIG)), scans)
    steps = [geometry.inverse(before.T_odom_lidar) @ after.T_odom_lidar for before, after in pairwise(results[13:])]
    np.testing.assert_allclose([T[:3, 3] for T in steps], [[STEP_M, 0.0, 0.0]] * len(steps), atol=0.05)


def test_a_motion_may_end_far_from_the_predicted_one_after_a_gap_only() -> None:
    model = MotionModel()
    assert model.may_exceed(0.1, 100.0) == 0.0, "nothing is known yet"
    steps = np.random.default_rng(0).normal(1.0, 0.02, 20)
    for step_m in steps:
        model.update(geometry.transform(np.eye(3), [step_m, 0.0, 0.0]), 1e-6 * np.eye(6), 1.0)
    assert model.may_exceed(1.0, 1.0) < 1e-9
    assert model.may_exceed(1.0, 30.0) == pytest.approx(0.8, abs=0.15), "0.04 m an interval, 30 ** 1.5 times"


def test_a_turn_that_a_scan_shows_does_not_make_a_slide_credible_that_it_does_not_show() -> None:
    """In front of a wall, a registration finds the turn to milliradians and ends anywhere along the wall."""
    model = MotionModel()
    for step_m in np.random.default_rng(0).normal(1.0, 0.02, 20):
        model.update(geometry.transform(np.eye(3), [step_m, 0.0, 0.0]), 1e-6 * np.eye(6), 1.0)
    measured = np.diag(np.square([0.003, 0.003, 0.003, 0.02, 50.0, 0.02]))
    fused, _ = model.fused(geometry.transform(geometry.yaw(0.3), [1.0, 3.0, 0.0]), measured, 1.0)
    assert geometry.angle(fused) == pytest.approx(0.3, abs=0.01)
    assert fused[1, 3] == pytest.approx(0.0, abs=0.2)
    seen, _ = model.fused(geometry.transform(geometry.yaw(0.3), [1.0, 3.0, 0.0]), 1e-6 * np.eye(6), 1.0)
    assert seen[1, 3] == pytest.approx(3.0, abs=0.01), "a slide that the scan shows is kept, however large"


@pytest.mark.parametrize("gaps", [[1.0] * 10, [1.0, 1.0, 5.0, 1.0, 1.0], [10.0, 1.0, 1.0], [1.0, 1.0, 1.0, 10.0]])
def test_errors_of_motions_that_scans_do_not_show_add_up_to_that_of_the_position(gaps: list[float]) -> None:
    """Along a tunnel the speed before is all that is known: its error is that of each motion."""
    model = MotionModel()
    for step_m in np.random.default_rng(0).normal(0.3, 0.02, 20):
        model.update(geometry.transform(np.eye(3), [step_m, 0.0, 0.0]), 1e-4 * np.eye(6), 1.0)
    measured = np.diag([*3 * [1e-4], 1e6, 1e-4, 1e-4])
    of_speed, added = [], []
    for gap in gaps:
        T_last_lidar = model.predicted(gap)
        of_speed.append((gap, model.fused(T_last_lidar, measured, gap)[1][3, 3] / gap**2))
        added.append(model.update(T_last_lidar, measured, gap)[1][3, 3])
    of_position = sum(m * n * min(a, b) for m, a in of_speed for n, b in of_speed)  # speeds share the earlier's error
    assert sum(added) == pytest.approx(of_position, rel=0.02), "and a little by the last one that was shown"


def test_errors_before_a_motion_that_is_known_are_not_those_of_later_ones() -> None:
    model = MotionModel()
    for step in np.random.default_rng(0).normal([0.0, 0.0, 0.0, 0.3, 0.0, 0.0], 0.02, (20, 6)):
        model.update(geometry.exp(step), 1e-4 * np.eye(6), 1.0)
    measured = np.diag([*3 * [1e-4], 1e6, 1e-4, 1e-4])
    for _ in range(5):
        model.update(model.predicted(1.0), measured, 1.0)
    model.restart(geometry.transform(np.eye(3), [0.3, 0.0, 0.0]))
    own = model.fused(model.predicted(1.0), measured, 1.0)[1]
    np.testing.assert_allclose(model.update(model.predicted(1.0), measured, 1.0)[1], own, atol=1e-12)


@pytest.mark.parametrize("is_seen", [True, False])
def test_a_scan_that_shows_the_position_again_makes_the_last_motion_as_unsure_as_the_jump(is_seen: bool) -> None:
    """Ten scans show only a wall along y; the next one shows also where along it, 2 m from the predicted place."""
    model = MotionModel()
    rng = np.random.default_rng(0)
    for step_m in rng.normal(0.3, 0.02, 20):
        model.update(geometry.transform(np.eye(3), [0.0, step_m, 0.0]), 1e-4 * np.eye(6), 1.0)
    along_m = 0.01 if is_seen else 50.0
    for _ in range(10):
        T_last_lidar = geometry.transform(np.eye(3), [0.0, 0.3 if is_seen else rng.uniform(-0.7, 1.3), 0.0])
        model.update(T_last_lidar, np.diag(np.square([0.01, 0.01, 0.01, 0.01, along_m, 0.01])), 1.0)
    T_jump = geometry.transform(np.eye(3), [0.0, 2.3, 0.0])
    fused, covariance = model.update(T_jump, 1e-4 * np.eye(6), 1.0)
    assert fused[1, 3] == pytest.approx(2.3, abs=0.05)
    if is_seen:
        assert covariance[4, 4] ** 0.5 < 0.3, "the position was known, so the motion changed"
    else:
        assert covariance[4, 4] ** 0.5 == pytest.approx(2.0, abs=0.3)
    assert covariance[3, 3] ** 0.5 < 0.05


def test_a_scan_that_shows_nothing_early_in_a_drive_does_no_harm() -> None:
    model = MotionModel()
    T_last_lidar = geometry.transform(np.eye(3), [0.3, 0.0, 0.0])
    for number in range(12):
        measured = np.eye(6) * (1e17 if number == 4 else 1e-6)
        _, covariance = model.update(T_last_lidar, measured, 1.0)
        assert np.linalg.eigvalsh(covariance)[0] > 0.0


def test_motions_that_were_not_shown_turn_with_the_sensor_until_a_new_map_begins() -> None:
    model = MotionModel()
    for moved_m in np.random.default_rng(0).normal([0.3, 0.0, 0.0], [0.02, 0.2, 0.02], (20, 3)):
        model.update(geometry.transform(np.eye(3), moved_m), 1e-6 * np.eye(6), 1.0)
    model.update(geometry.transform(np.eye(3), [0.3, 0.0, 0.0]), np.diag([*4 * [1e-6], 100.0, 1e-6]), 1.0)
    before = sum(model._unseen)
    model.follow(geometry.transform(geometry.yaw(np.pi / 2), [0.3, 0.0, 0.0]), 1.0)
    after = sum(model._unseen)
    np.testing.assert_allclose(np.diag(after)[3:], np.diag(before)[[4, 3, 5]], atol=1e-9)
    assert after[3, 3] > 10.0 * after[4, 4]
    model.begin_map()
    _, covariance = model.update(geometry.transform(geometry.yaw(np.pi / 2), [2.3, 0.0, 0.0]), 1e-6 * np.eye(6), 1.0)
    assert covariance[3, 3] < 0.01, "not the last position but the motion changed"


@pytest.mark.long
@pytest.mark.parametrize("is_better", [True, False])
def test_a_map_before_a_break_is_used_again_if_it_explains_the_scan_better(is_better: bool) -> None:
    scans, truth = round_drive()
    odometry = _checked(truth.T_world_lidar)
    last = _registered(odometry, scans[:SLIP_AT])[-1].T_odom_lidar
    before, odometry._scans.local = odometry._scans.local, LocalMap(CONFIG.refine, Correlation(WINDOW))
    odometry._scans._lost = before, odometry._motion.T_step, 1.0
    scan = SeenScan(scans[SLIP_AT].points, CONFIG.refine)
    T_odom_lidar = last @ geometry.inverse(truth.T_world_lidar[SLIP_AT - 1]) @ truth.T_world_lidar[SLIP_AT]
    there = before.register(scan, geometry.inverse(before.T_odom_map) @ T_odom_lidar)[0]
    here = replace(there, mean_log=there.mean_log + (-1.0 if is_better else 0.5) * there.num_patches**-0.5)
    proposed = _proposed(scan, T_odom_lidar)
    assert (odometry._scans._rejoined(proposed, [here]) is not None) is is_better
    assert (odometry._scans.local is before) is is_better


@pytest.mark.long
@pytest.mark.parametrize(("num_steps", "gap"), [(4, 1.0), (2, 3.0)])
def test_a_map_before_a_break_is_found_again_where_the_motion_before_it_leads(num_steps: int, gap: float) -> None:
    """One scan shows another place; the next one, 18 m on, is the second of this speed, or comes after three intervals.

    The odometry is far off since then.
    """
    scans, truth = round_drive()
    odometry = _checked(truth.T_world_lidar)
    last = _registered(odometry, scans[:SLIP_AT])[-1].T_odom_lidar
    before, odometry._scans.local = odometry._scans.local, LocalMap(CONFIG.refine, Correlation(WINDOW))
    T_step, T_last_true = (
        geometry.inverse(truth.T_world_lidar[SLIP_AT - 1]) @ truth.T_world_lidar[SLIP_AT - 1 + num]
        for num in (num_steps, 8)
    )
    odometry._scans._lost = before, T_step, 1.0
    while len(odometry._scans._last_fits) > 1:  # that of the second scan, in a map as sparse as here
        odometry._scans._last_fits.pop()
    far_off = last @ geometry.transform(geometry.yaw(2.0), [0.0, -40.0, 0.0])
    scan = SeenScan(scans[SLIP_AT + 7].points, CONFIG.refine)
    found = odometry._scans._rejoined(_proposed(scan, far_off, gap), [])
    assert found is not None
    T_last_found = geometry.inverse(last) @ before.T_odom_map @ found[1][0].T_map_lidar
    assert geometry.distance(geometry.inverse(T_last_true) @ T_last_found) < 0.1


def test_an_odometry_that_reports_no_motion_is_checked_too() -> None:
    scans, truth = round_drive()
    standing = [replace(scans[0], index=row, stamp_ns=row * 100_000_000) for row in range(21)]
    poses = np.repeat(truth.T_world_lidar[:1], 21, axis=0)
    given = GivenOdometry(Trajectory(np.arange(21), np.arange(21) * 100_000_000, poses), CONFIG.odometry)
    results = _registered(CheckedOdometry(given, CONFIG, recover=partial(register, config=CONFIG)), standing)
    assert all(result.motion and result.motion.overlap is not None for result in results[1:])


def test_a_turn_that_the_odometry_does_not_follow_is_found_while_the_search_reaches_it() -> None:
    """The poses of the odometry stay where they were."""
    scans, truth = round_drive()
    last = scans[SLIP_AT - 1]
    turns = [geometry.transform(geometry.yaw(np.radians(15.0 * count)), np.zeros(3)) for count in range(1, 7)]
    turned = [
        replace(scans[SLIP_AT + row], points=geometry.apply(geometry.inverse(turn), last.points), labels=last.labels)
        for row, turn in enumerate(turns)
    ]
    poses = truth.T_world_lidar.copy()
    poses[SLIP_AT:] = poses[SLIP_AT - 1]
    none = Rejected(RejectReason.HIGH_RESIDUAL)
    trajectory = replace(truth, T_world_lidar=poses)
    odometry = CheckedOdometry(_LikeKiss(trajectory, CONFIG.odometry), CONFIG, recover=lambda source, target: none)
    before = _registered(odometry, scans[:SLIP_AT])[-1].T_odom_lidar
    results = zip(turns, _registered(odometry, turned), strict=True)
    offs = [geometry.inverse(before @ turn) @ result.T_odom_lidar for turn, result in results]
    best = min(offs[-3:], key=geometry.angle)
    assert geometry.distance(best) < 0.1
    assert np.degrees(geometry.angle(best)) < 0.5
