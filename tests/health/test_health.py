"""Wrong motions of an odometry are detected with the scans, and repaired."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from helpers.drives import STEP_M, drifting, round_drive, round_sweeps

from segslam import geometry
from segslam.config import Config, load_config
from segslam.evaluation import trajectory_metrics
from segslam.health import CheckedOdometry, information_of
from segslam.health.check import Nudge, nudge, open_direction
from segslam.health.history import History, Intervals
from segslam.health.local_map import Fit, LocalMap
from segslam.odometry import GivenOdometry, KissOdometry, OdometryResult
from segslam.refinement import LightSurface
from segslam.refinement import refine as refined
from segslam.registration import register
from segslam.slam import Slam
from segslam.types import Motion, MotionState, Registration, Rejected, RejectReason, Scan, Trajectory

CONFIG = load_config(None, ["proximity.min_travel_m=60"])
SLIP_AT = 20


def _given(poses: np.ndarray, config: Config = CONFIG) -> GivenOdometry:
    return GivenOdometry(replace(round_drive()[1], T_world_lidar=poses), config.odometry)


def _checked(poses: np.ndarray, config: Config = CONFIG) -> CheckedOdometry:
    return CheckedOdometry(_given(poses, config), config, recover=partial(register, config=config))


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


@pytest.mark.parametrize(("metres", "degrees"), [(3.0, 0.0), (-1.0, 0.0), (0.0, 40.0), (0.4, 3.0)])
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


@pytest.mark.parametrize("metres", [-2.5, -STEP_M, 0.0])
def test_a_wrong_first_motion_is_repaired_and_a_right_one_is_kept(metres: float) -> None:
    scans, truth = round_drive()
    trajectory = replace(truth, T_world_lidar=_slipped(metres=metres, at=1))
    odometry = CheckedOdometry(_LikeKiss(trajectory, CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))
    results = _registered(odometry, scans[:3])
    motion = results[1].motion
    assert motion is not None
    assert (motion.state is MotionState.REPAIRED) == (metres != 0.0)
    assert _worst_step_m(results[:2]) < 0.06


def test_without_the_check_a_jump_remains() -> None:
    config = load_config(None, ["health.check=false"])
    results = _registered(_checked(_slipped(metres=3.0), config), round_drive()[0][: SLIP_AT + 2])
    assert _worst_step_m(results) == pytest.approx(3.0, abs=0.01)
    assert results[-1].motion is None


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


@pytest.mark.parametrize("interval_s", [0.3, 6.0])
def test_a_scan_from_another_town_is_a_break_though_the_odometry_is_steady(interval_s: float) -> None:
    scans, _ = round_drive()
    odometry = CheckedOdometry(KissOdometry(CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))
    before = _registered(odometry, scans[:20])
    sweeps = round_sweeps(seed=13, only=range(20, 22))
    since_ns = scans[19].stamp_ns + int(interval_s * 1e9)
    others = [one.scan(index=20 + k, stamp_ns=since_ns + k * 300_000_000) for k, one in enumerate(sweeps)]
    results = _registered(odometry, others)
    states = [result.motion.state for result in results if result.motion]
    assert states[0] is MotionState.BROKEN
    assert states[1] is MotionState.REFINED
    T_break = geometry.inverse(before[-1].T_odom_lidar) @ results[0].T_odom_lidar
    assert np.degrees(geometry.angle(T_break)) < 60.0, "the turn, 7 degrees a scan, ends in the gap of 20 scans"


def test_a_long_pause_before_the_second_scan_does_not_set_the_usual_interval() -> None:
    intervals = Intervals()
    stamps_s = [0.0, 6.0, 6.1, 6.2, 6.3, 6.4, 7.4, 7.5]
    gaps = [intervals.note(int(stamp_s * 1e9)) for stamp_s in stamps_s]
    np.testing.assert_allclose(gaps, [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 10.0, 1.0], rtol=1e-6)


def test_an_unsupported_motion_is_a_break_and_is_repaired_when_the_map_is_visible_again() -> None:
    scans, truth = round_drive()
    given = [*scans[:20], _elsewhere(scans[20]), *scans[21:26]]
    results = _registered(_checked(truth.T_world_lidar), given)
    states = [result.motion.state for result in results if result.motion]
    assert states[20] is MotionState.BROKEN
    information = results[20].motion and results[20].motion.information
    assert information is not None
    assert np.sqrt(1 / information[3, 3]) >= 5.0, "metres"
    assert states[21] is MotionState.REJOINED
    assert results[21].motion is not None
    np.testing.assert_array_equal(results[21].motion.information, information)  # the scan before is at a guess
    assert (
        geometry.distance(
            geometry.inverse(geometry.inverse(truth.T_world_lidar[19]) @ truth.T_world_lidar[21])
            @ geometry.inverse(results[19].T_odom_lidar)
            @ results[21].T_odom_lidar
        )
        < 0.1
    )


def test_an_odometry_that_fails_again_is_watched_for_longer() -> None:
    history, fits = History(CONFIG.health), Fit(0.9, 0.1)

    def watched() -> int:
        """Number of registrations that confirm the odometry until it is no longer watched."""
        count = 0
        while history.is_watching:
            history.note_registration(0.0, 0.0, fits)
            count += 1
        return count

    lengths = []
    for _ in range(3):
        assert history.note_registration(1.0, 0.0, fits) is MotionState.REPAIRED
        lengths.append(watched())
    assert lengths == [CONFIG.health.watch_scans * n for n in (1, 2, 3)]


def test_sparse_scans_after_a_break_are_compared_with_what_one_scan_shows_and_not_with_the_usual_overlap() -> None:
    history = History(CONFIG.health)
    for _ in range(10):
        history.note_registration(0.0, 0.0, Fit(0.9, 0.1))
    low, supported, poor = Fit(0.4, 0.15), Fit(0.2, 0.15), Fit(0.4, 0.25)
    assert not history.is_usual(low)
    assert not history.is_plausible(supported)
    assert history.is_usual(replace(low, is_map_new=True))
    assert history.is_plausible(replace(supported, is_map_new=True))
    assert not history.is_usual(replace(poor, is_map_new=True))

    scans, truth = round_drive()
    local = LocalMap(CONFIG.health, CONFIG.refine)
    is_new = []
    for scan, T_odom_lidar in zip(scans[:10], truth.T_world_lidar, strict=False):
        local.add(T_odom_lidar, local.downsample(scan.points), scan.points)
        is_new.append(local.fit(local.make_surface(local.downsample(scan.points)), np.eye(4)).is_map_new)
    assert is_new == [True] * 4 + [False] * 6


@pytest.mark.parametrize("degrees", [-25.0, 32.0])
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


def test_a_rotation_of_some_degrees_is_checked_however_near_the_prediction_it_is() -> None:
    config = load_config(None, ["keyframes.distance_m=20", "keyframes.angle_deg=40"])
    scans, truth = round_drive()  # 7 degrees from scan to scan
    results = _registered(_checked(truth.T_world_lidar, config), scans[:5])
    assert [result.motion.state for result in results[1:] if result.motion] == 4 * [MotionState.CONFIRMED]


def test_a_check_with_little_overlap_confirms_nothing_even_at_the_start() -> None:
    history = History(CONFIG.health)
    history.note_check(Nudge(np.eye(4), overlap=0.13, moved_m=0.01, moved_rad=0.001))
    assert history.is_watching


def test_a_keyframe_follows_a_break_and_its_motion_has_nearly_no_information() -> None:
    scans, truth = round_drive()
    slam = Slam(CONFIG, odometry=_given(truth.T_world_lidar))
    steps = [slam.process(scan) for scan in [*scans[:20], _elsewhere(scans[20]), *scans[21:24]]]
    keyframe, before = steps[20].keyframe, steps[19].keyframe
    assert keyframe is not None
    assert before is not None
    assert keyframe.travel_m - before.travel_m > 1e4
    assert [step.motion.state for step in steps if step.motion][20] is MotionState.BROKEN


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


def test_recovery_without_initial_guess_runs_only_where_guesses_fail() -> None:
    asked = []

    def recover(source: np.ndarray, target: np.ndarray) -> Rejected:
        asked.append((len(source), len(target)))
        return Rejected(RejectReason.SMALL_CLIQUE)

    scans, truth = round_drive()
    odometry = CheckedOdometry(_given(truth.T_world_lidar), CONFIG, recover=recover)
    _registered(odometry, [*scans[:20], _elsewhere(scans[20])])
    assert len(asked) == 1


@pytest.mark.parametrize("moved_m", [0.1, 0.2])
def test_the_quick_check_measures_a_small_slip(moved_m: float) -> None:
    scans, truth = round_drive()
    local = LocalMap(CONFIG.health, CONFIG.refine)
    target = LightSurface(local.downsample(scans[0].points))
    T_target_source = geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[1]
    slip = geometry.transform(np.eye(3), [moved_m, 0.0, 0.0])
    found = nudge(local.downsample(scans[1].points), target, T_target_source @ slip)
    assert found is not None
    assert found.moved_m == pytest.approx(moved_m, abs=0.06)


@pytest.mark.parametrize(
    "last", [SLIP_AT + 1, *(pytest.param(last, marks=pytest.mark.slow) for last in (15, SLIP_AT + 12))]
)
def test_a_checked_odometry_continues_after_restore(last: int) -> None:
    scans, _ = round_drive()
    poses = _slipped(metres=2.0)
    whole = _registered(_checked(poses), scans[:36])
    head = whole[: last + 1]
    restored = _checked(poses)
    restored.restore(
        np.stack([result.T_odom_lidar for result in head]),
        [result.motion for result in head if result.motion],
        np.array([scan.stamp_ns for scan in scans[: last + 1]]),
        lambda row: scans[row],
    )
    tail = _registered(restored, scans[last + 1 : 36])
    np.testing.assert_allclose(
        [result.T_odom_lidar for result in tail], [result.T_odom_lidar for result in whole[last + 1 :]], atol=1e-6
    )
    states = [[result.motion.state for result in results if result.motion] for results in (tail, whole[last + 1 :])]
    assert states[0] == states[1]


def _behind_a_van(scan: Scan) -> np.ndarray:
    """What a sensor with 40 degrees of view sees behind a van that drives as fast as its own vehicle."""
    in_view = np.abs(np.arctan2(scan.points[:, 1], scan.points[:, 0])) < np.radians(20.0)
    sides = np.mgrid[9:15:0.25, -1:1.1:2, -1.5:1:0.25].reshape(3, -1).T
    back = np.mgrid[9:10, -1:1.1:0.25, -1.5:1:0.25].reshape(3, -1).T
    return np.vstack([scan.points[in_view], sides, back]).astype(np.float32)


def test_a_vehicle_that_drives_ahead_does_not_hold_a_registration_back() -> None:
    scans, truth = round_drive()
    local = LocalMap(CONFIG.health, CONFIG.refine)
    for row in range(10):
        points = _behind_a_van(scans[row])
        local.add(truth.T_world_lidar[row], local.downsample(points), points)
    surface = local.make_surface(local.downsample(_behind_a_van(scans[10])))
    T_true = geometry.inverse(local.T_odom_map) @ truth.T_world_lidar[10]
    found = local.register(surface, T_true)
    best = max(found, key=lambda T_map_lidar: local.fit(surface, T_map_lidar).closeness)
    assert geometry.distance(geometry.inverse(T_true) @ best) < 0.1
    refine = CONFIG.refine.model_copy(update={"correspondence_m": CONFIG.health.correspondence_m})
    by_gicp = refined(surface, local.surface(), T_true, config=refine, must_converge=False)
    assert isinstance(by_gicp, Registration)
    assert geometry.distance(geometry.inverse(T_true) @ by_gicp.T_target_source) > 0.3


def test_kiss_icp_follows_a_repair() -> None:
    scans, truth = round_drive()
    odometry = KissOdometry(CONFIG.odometry)
    for scan in scans[:5]:
        odometry.register(scan)
    local = LocalMap(CONFIG.health, CONFIG.refine)
    T_first = geometry.inverse(truth.T_world_lidar[0])
    placed = [(T_first @ truth.T_world_lidar[k], local.downsample(scans[k].points)) for k in range(5)]
    moved = geometry.transform(np.eye(3), [100.0, 0.0, 0.0])
    odometry.follow(
        [(moved @ T_odom_lidar, points) for T_odom_lidar, points in placed],
        moved @ placed[-1][0],
        geometry.inverse(placed[-2][0]) @ placed[-1][0],
    )
    expected = moved @ T_first @ truth.T_world_lidar[5]
    assert geometry.distance(geometry.inverse(expected) @ odometry.register(scans[5]).T_odom_lidar) < 0.1


def test_drift_too_small_for_one_check_is_seen_in_many() -> None:
    scans, truth = round_drive()
    biased: Trajectory = drifting(truth, turn_deg=0.45, climb_m=0.0)
    motions = [result.motion for result in _registered(_checked(biased.T_world_lidar), scans[:14])]
    registered = [row for row, motion in enumerate(motions) if motion and motion.rms_m is not None]
    assert registered, "many checks that are off by 0.45 of 0.6 degrees"
    assert min(registered) > 5


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


def test_a_scan_of_a_smooth_tunnel_is_open_along_it_and_one_of_a_street_is_not() -> None:
    local = LocalMap(CONFIG.health, CONFIG.refine)
    R = geometry.yaw(0.3)
    tunnel = (_tunnel_scan(0).points @ R.T).astype(np.float32)
    direction = open_direction(LightSurface(local.downsample(tunnel)))
    assert direction is not None
    assert abs(direction @ R[:, 0]) > 0.999
    assert open_direction(LightSurface(local.downsample(round_drive()[0][0].points))) is None


def test_in_a_smooth_tunnel_the_last_motion_continues_and_is_reported_as_uncertain() -> None:
    odometry = CheckedOdometry(KissOdometry(CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))
    results = _registered(odometry, _into_a_tunnel())
    motions = [result.motion for result in results[13:] if result.motion is not None]
    assert {motion.state for motion in motions} == {MotionState.BROKEN}
    assert all(motion.information is not None for motion in motions)
    steps = [geometry.inverse(before.T_odom_lidar) @ after.T_odom_lidar for before, after in pairwise(results[13:])]
    np.testing.assert_allclose([T[0, 3] for T in steps], STEP_M, rtol=0.1)
    way_m = geometry.distance(geometry.inverse(results[10].T_odom_lidar) @ results[-1].T_odom_lidar)
    information = information_of([result.motion for result in results[11:] if result.motion is not None])
    assert information is not None
    sigmas_m = np.sqrt(np.diag(np.linalg.inv(information)))[3:]
    assert sigmas_m[0] == pytest.approx(0.7 * way_m, rel=0.05), "the error grows with the way, not with its root"
    assert max(sigmas_m[1:]) < 1.0


def test_the_scan_behind_a_tunnel_continues_the_drive_without_a_break() -> None:
    street = round_drive()[0]
    behind = [replace(scan, index=row, stamp_ns=row * 100_000_000) for row, scan in enumerate(street[60:66], start=20)]
    odometry = CheckedOdometry(KissOdometry(CONFIG.odometry), CONFIG, recover=partial(register, config=CONFIG))
    results = _registered(odometry, [*_into_a_tunnel(20), *behind])
    assert not any(result.motion.is_break for result in results if result.motion)
    exit_motion = results[20].motion
    assert exit_motion is not None
    assert exit_motion.state is MotionState.BROKEN
    sigmas = np.sqrt(np.diag(np.linalg.inv(exit_motion.information)))
    assert sigmas[3] > 2.0, "metres along the tunnel"
    assert sigmas[4] < 0.5
    assert {result.motion.state for result in results[21:] if result.motion} <= {
        MotionState.CONFIRMED,
        MotionState.REFINED,
        MotionState.REPAIRED,
        MotionState.REJOINED,  # the round ends where the tunnel began
    }
    truth = round_drive()[1].T_world_lidar
    for row, result in enumerate(results[21:], start=21):
        if result.motion is not None and result.motion.state is MotionState.REJOINED:
            T_true_found = geometry.inverse(geometry.inverse(truth[10]) @ truth[row + 40]) @ (
                geometry.inverse(results[10].T_odom_lidar) @ result.T_odom_lidar
            )
            assert geometry.distance(T_true_found) < 0.2


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


def test_an_odometry_that_reports_no_motion_is_checked_too() -> None:
    scans, truth = round_drive()
    standing = [replace(scans[0], index=row, stamp_ns=row * 100_000_000) for row in range(21)]
    poses = np.repeat(truth.T_world_lidar[:1], 21, axis=0)
    given = GivenOdometry(Trajectory(np.arange(21), np.arange(21) * 100_000_000, poses), CONFIG.odometry)
    results = _registered(CheckedOdometry(given, CONFIG, recover=partial(register, config=CONFIG)), standing)
    checked = [row for row, result in enumerate(results) if result.motion and result.motion.overlap is not None]
    assert checked == [10, 20]
