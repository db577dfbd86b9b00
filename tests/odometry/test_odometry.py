import multiprocessing
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from segslam.core import geometry
from segslam.core.config import OdometryConfig
from segslam.core.types import BadScan, Scan, SegslamError, Trajectory
from segslam.odometry.apart import OdometryApart
from segslam.odometry.kiss import KissOdometry
from segslam.odometry.sweep import GivenOdometry, deskew_scan
from segslam.odometry.sweep_motion import SweepMotion, at_middle

CONFIG = OdometryConfig()
ONE_THREAD = OdometryConfig(max_num_threads=1)  # the first odometry of a process sets how many all of it have


def _scan(points: np.ndarray, *, index: int = 0, stamp_ns: int = 0, times: np.ndarray | None = None) -> Scan:
    """Labels number the points, so that a row out of step shows."""
    labels = (np.arange(len(points)) % 26).astype(np.uint8)
    return Scan(points, stamp_ns, index, labels, np.empty(0) if times is None else times)


def _room(rng: np.random.Generator, num: int = 4000) -> np.ndarray:
    """(n, 3) points on the floor and walls of a hall, the sensor at the origin."""
    walls = rng.uniform(-1.0, 1.0, (num, 3)) * [30.0, 20.0, 2.0]
    side = np.arange(num) % 3
    walls[side == 0, 2] = -1.7
    walls[side == 1, 0] = 30.0 * np.sign(walls[side == 1, 0])
    walls[side == 2, 1] = 20.0 * np.sign(walls[side == 2, 1])
    return walls


def _forward(metres: float) -> np.ndarray:
    return geometry.transform(np.eye(3), [metres, 0.0, 0.0])


def _trajectory(T_world_lidar: np.ndarray, *, first: int = 0) -> Trajectory:
    index = np.arange(first, first + len(T_world_lidar))
    return Trajectory(index, index * 100_000_000, T_world_lidar)


def test_the_first_pose_is_the_identity() -> None:
    points = _room(np.random.default_rng(0))
    given = _trajectory(np.array([_forward(7.0), _forward(8.0)]))
    for odometry in (KissOdometry(CONFIG), GivenOdometry(given, CONFIG)):
        result = odometry.register(_scan(points))
        np.testing.assert_allclose(result.T_odom_lidar, np.eye(4), atol=1e-12)


def test_kiss_follows_a_sensor_through_a_hall() -> None:
    rng = np.random.default_rng(0)
    odometry = KissOdometry(CONFIG)
    for i in range(6):
        T_odom_lidar = _forward(0.3 * i)
        points = geometry.apply(geometry.inverse(T_odom_lidar), _room(rng, 20_000))
        result = odometry.register(_scan(points, index=i))
    error = geometry.inverse(T_odom_lidar) @ result.T_odom_lidar
    assert geometry.distance(error) < 0.1, "a tenth of a voxel: every scan samples the walls differently"
    assert np.degrees(geometry.angle(error)) < 0.2


def test_one_thread_repeats_to_the_bit() -> None:
    scans = [_scan(geometry.apply(_forward(-0.3 * i), _room(np.random.default_rng(i))), index=i) for i in range(4)]
    with OdometryApart(ONE_THREAD) as one, OdometryApart(ONE_THREAD) as other:
        first, second = ([odometry.register(scan).T_odom_lidar for scan in scans] for odometry in (one, other))
    np.testing.assert_array_equal(first, second)


def test_a_process_of_its_own_changes_nothing() -> None:
    """Poses, points, labels, and a scan that cannot be used between them."""
    scans = _street(6)
    within = KissOdometry(CONFIG)
    expected = [within.register(scan) for scan in scans]
    with OdometryApart(CONFIG) as apart:
        found = [apart.register(scan) for scan in scans[:5]]
        with pytest.raises(BadScan, match="scan 5: none of its 1 points"):
            apart.register(_scan(np.zeros((1, 3)), index=5))
        found.append(apart.register(scans[5]))
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_array_equal(mine.T_odom_lidar, theirs.T_odom_lidar)
        np.testing.assert_array_equal(mine.points, theirs.points)
        np.testing.assert_array_equal(mine.labels, theirs.labels)


def test_poses_are_the_same_in_each_run_though_sums_differ_by_rounding() -> None:
    scans, rng = _street(6), np.random.default_rng(0)
    rounded = [replace(scan, points=scan.points + rng.normal(0.0, 1e-12, scan.points.shape)) for scan in scans]
    expected, found = _by_kiss_icp(scans), _by_kiss_icp(rounded)
    np.testing.assert_array_equal(found, expected)
    assert geometry.distance(expected[-1]) > 1.0
    np.testing.assert_allclose(expected[-1][:3, :3] @ expected[-1][:3, :3].T, np.eye(3), atol=1e-14)


def _by_kiss_icp(scans: list[Scan]) -> list[np.ndarray]:
    plain = KissOdometry(ONE_THREAD)
    found = [plain.register(scan).T_odom_lidar for scan in scans]
    assert len(plain.alone()) == 0, "not kept unless wanted"
    return found


@contextmanager
def _keeping_alone(*, apart: bool) -> Iterator[KissOdometry]:
    with OdometryApart(ONE_THREAD, keeps_alone=True) if apart else nullcontext() as other:
        yield other or KissOdometry(ONE_THREAD, keeps_alone=True)


@pytest.mark.parametrize("apart", [False, True])
def test_the_poses_of_kiss_icp_alone_are_kept_while_the_odometry_follows_others(apart: bool) -> None:
    scans = _street(8)
    expected = _by_kiss_icp(scans)
    with _keeping_alone(apart=apart) as odometry:
        found = []
        for number, scan in enumerate(scans):
            found.append(odometry.register(scan))
            if number == 3:
                T_moved = geometry.transform(np.eye(3), [0.5, 0.1, 0.0]) @ found[-1].T_odom_lidar
                odometry.follow([(T_moved, found[-1].points)], T_moved, np.eye(4))
        if not apart:
            np.testing.assert_allclose(odometry.alone(), expected, atol=1e-9)
    np.testing.assert_allclose(odometry.alone(), expected, atol=1e-9)
    assert geometry.distance(geometry.inverse(found[-1].T_odom_lidar) @ expected[-1]) > 0.1


@pytest.mark.parametrize("apart", [False, True])
def test_the_poses_of_kiss_icp_alone_are_those_at_the_stamps(apart: bool) -> None:
    sweeps = [replace(scan, times=np.linspace(0.0, 1.0, len(scan.points))) for scan in _street(7)]
    ends, starts = [], []
    for stamp_time, found in ((1.0, ends), (0.0, starts)):
        with _keeping_alone(apart=apart) as odometry:
            _followed(odometry, [replace(scan, stamp_time=stamp_time) for scan in sweeps], foresees=apart)
            found += odometry.alone()
    before = [np.eye(4), np.eye(4), *ends]
    motions = [geometry.inverse(one) @ other for one, other in pairwise(before)][: len(ends)]
    expected = [T_odom_end @ geometry.inverse(motion) for T_odom_end, motion in zip(ends, motions, strict=True)]
    assert geometry.distance(motions[-1]) > 0.1
    np.testing.assert_allclose(starts, expected, atol=1e-9)


def _followed(odometry: KissOdometry, scans: list[Scan], *, foresees: bool) -> list[np.ndarray]:
    """Poses of scans, of which the fourth and the sixth are moved; the third is not foreseen."""
    found = []
    for number, scan in enumerate(scans):
        found.append(odometry.register(scan))
        if foresees and number + 1 < len(scans) and number != 1:
            odometry.foresee(scans[number + 1], gap=1.0)
        if number in (3, 5):
            T_moved = geometry.transform(np.eye(3), [0.5, 0.1, 0.0]) @ found[-1].T_odom_lidar
            odometry.follow([(T_moved, found[-1].points)], T_moved, np.eye(4))
    return [result.T_odom_lidar for result in found]


@pytest.mark.long
def test_work_on_the_next_scan_begins_early_and_changes_nothing() -> None:
    scans = [*_street(7), _scan(np.zeros((1, 3)), index=7)]
    with OdometryApart(ONE_THREAD, keeps_alone=True) as plain, OdometryApart(ONE_THREAD, keeps_alone=True) as early:
        expected = _followed(plain, scans[:-1], foresees=False)
        found = _followed(early, scans[:-1], foresees=True)
        early.foresee(scans[-1], gap=1.0)
        with pytest.raises(BadScan, match="scan 7: none of its 1 points"):
            early.register(scans[-1])
    with OdometryApart(ONE_THREAD) as without_alone:
        np.testing.assert_array_equal(_followed(without_alone, scans[:-1], foresees=True), expected)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(early.alone(), plain.alone())
    assert len(without_alone.alone()) == 0


def test_a_sweep_too_large_for_the_shared_memory_is_aligned_like_any_other(monkeypatch: pytest.MonkeyPatch) -> None:
    scans = _street(3)
    monkeypatch.setattr("segslam.odometry.apart.MOST_SHARED", 100)
    with OdometryApart(ONE_THREAD) as apart:
        found = [apart.register(scan).T_odom_lidar for scan in scans]
    monkeypatch.undo()
    with OdometryApart(ONE_THREAD) as apart:
        np.testing.assert_array_equal(found, [apart.register(scan).T_odom_lidar for scan in scans])


def test_a_process_that_was_killed_is_reported_with_the_remedy() -> None:
    scan = _street(1)[0]
    odometry = OdometryApart(CONFIG)
    odometry.register(scan)
    (process,) = multiprocessing.active_children()
    process.kill()
    process.join()
    with pytest.raises(SegslamError, match=r"exit code -9.*--resume"):
        odometry.register(scan)


@pytest.mark.long
def test_a_script_that_runs_again_when_imported_ends_with_the_remedy(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "import numpy as np\nfrom segslam.core.config import OdometryConfig\nfrom segslam.core.types import Scan\n"
        "from segslam.odometry.apart import OdometryApart\n"
        "OdometryApart(OdometryConfig()).register(Scan(np.full((9, 3), 9.0), 0, 0))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1
    assert 'a script without `if __name__ == "__main__":`' in done.stderr


def test_points_out_of_range_leave_with_their_labels() -> None:
    points = np.array([[1.0, 0, 0], [10.0, 0, 0], [np.nan, 0, 0], [0, 20.0, 0], [500.0, 0, 0], [0, 0, -30.0]])
    result = KissOdometry(CONFIG).register(_scan(points))
    np.testing.assert_array_equal(result.points, points[[1, 3, 5]].astype(np.float32))
    np.testing.assert_array_equal(result.labels, [1, 3, 5])
    assert result.points.dtype == np.float32


def test_intensities_go_with_their_points_through_the_process_apart() -> None:
    scan = _street(1)[0]
    measured = replace(scan, intensities=np.linalg.norm(scan.points, axis=1).astype(np.float32))
    given = GivenOdometry(_trajectory(np.eye(4)[None]), CONFIG)
    with OdometryApart(CONFIG) as apart:
        for result in (apart.register(measured), given.register(measured)):
            np.testing.assert_allclose(result.intensities, np.linalg.norm(result.points, axis=1), rtol=1e-6)
            assert 0 < len(result.points) < len(scan.points), "those out of range have gone"
    assert KissOdometry(CONFIG).register(scan).intensities is None


def test_a_scan_that_moved_is_brought_to_the_end_of_its_sweep() -> None:
    """The sensor moves 1 m a sweep: what it saw at the start has come 1 m nearer by the end, labels in step."""
    wall = np.array([[10.0, y, z] for y in (-2.0, 0.0, 2.0) for z in (-1.0, 1.0)])
    times = np.linspace(0.0, 1.0, len(wall))
    seen = wall - np.column_stack([1.0 * times, 0 * times, 0 * times])
    odometry = GivenOdometry(_trajectory(np.array([_forward(-1.0), _forward(0.0), _forward(1.0)])), CONFIG)
    odometry.register(_scan(wall))
    result = odometry.register(_scan(seen, index=1, times=times))
    np.testing.assert_allclose(result.points, wall - [1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(result.labels, np.arange(len(wall)))


def test_motion_compensation_may_carry_points_out_of_range_and_their_labels_go_too() -> None:
    near = np.array([[3.5, 0.0, 0.0], [3.5, 0.1, 0.0], [9.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [9.0, 1.0, 0.0]])
    times = np.array([0.0, 1.0, 0.0, 0.5, 1.0])
    odometry = GivenOdometry(_trajectory(np.array([_forward(0.0), _forward(1.0)])), CONFIG)
    odometry.register(_scan(near))
    result = odometry.register(_scan(near, index=1, times=times))
    np.testing.assert_array_equal(result.labels, [1, 2, 4])
    np.testing.assert_allclose(result.points, [[3.5, 0.1, 0.0], [8.0, 0.0, 0.0], [9.0, 1.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("times", [np.empty(0), np.full(5, 0.3)], ids=["none", "all equal"])
def test_without_times_nothing_is_compensated(times: np.ndarray) -> None:
    points = np.array([[5.0 + i, 0.0, 0.0] for i in range(5)])
    odometry = GivenOdometry(_trajectory(np.array([_forward(0.0), _forward(1.0)])), CONFIG)
    odometry.register(_scan(points))
    np.testing.assert_array_equal(odometry.register(_scan(points, index=1, times=times)).points, points)


def test_compensation_can_be_switched_off() -> None:
    points = np.array([[5.0 + i, 0.0, 0.0] for i in range(5)])
    odometry = GivenOdometry(_trajectory(np.array([_forward(0.0), _forward(1.0)])), OdometryConfig(deskew=False))
    odometry.register(_scan(points))
    times = np.linspace(0.0, 1.0, 5)
    np.testing.assert_array_equal(odometry.register(_scan(points, index=1, times=times)).points, points)


def test_a_given_pose_is_found_by_the_number_of_its_scan() -> None:
    odometry = GivenOdometry(_trajectory(np.array([_forward(x) for x in (1.0, 3.0, 6.0)]), first=40), CONFIG)
    points = _room(np.random.default_rng(0), 30)
    poses = [odometry.register(_scan(points, index=i)).T_odom_lidar for i in (40, 42)]
    np.testing.assert_allclose(poses, [_forward(0.0), _forward(5.0)])


def test_a_given_pose_is_found_by_its_stamp() -> None:
    given = _trajectory(np.array([_forward(x) for x in (1.0, 3.0, 6.0)]))
    odometry = GivenOdometry(given, CONFIG, match="stamp")
    points = _room(np.random.default_rng(0), 30)
    stamps = (100_000_000 - 9_000_000, 200_000_000 + 9_000_000)
    poses = [odometry.register(_scan(points, index=70, stamp_ns=stamp)).T_odom_lidar for stamp in stamps]
    np.testing.assert_allclose(poses, [_forward(0.0), _forward(3.0)])


@pytest.mark.parametrize("stamp_time", [0.0, 1.0])
def test_by_given_poses_at_its_start_and_end_the_motion_during_a_sweep_is_known(stamp_time: float) -> None:
    """The sensor moves by another distance in each sweep, and the last motion is not that during this one."""
    at_m = np.array([0.0, 1.0, 5.0, 3.0])
    given = Trajectory(np.arange(4), 10**8 * np.arange(4), np.array([_forward(x) for x in at_m]))
    odometry = GivenOdometry(given, OdometryConfig(min_range_m=0.0), match="stamp")
    world, times = np.random.default_rng(0).uniform(-20.0, 20.0, (30, 3)), np.linspace(0.0, 1.0, 30)
    for sweep in range(3):
        stamp = sweep + round(stamp_time)
        moved_m = at_m[sweep] + times * (at_m[sweep + 1] - at_m[sweep])
        measured = world - np.column_stack([moved_m, np.zeros((30, 2))])
        scan = Scan(measured, 10**8 * stamp, stamp, times=times, sweep_s=0.1, stamp_time=stamp_time)
        np.testing.assert_allclose(odometry.register(scan).points, world - [at_m[stamp], 0.0, 0.0], atol=1e-5)


def test_a_scan_between_two_given_poses_has_one_between_them() -> None:
    stamps_ns = np.arange(0, 100_000_000, 10_000_000)
    T_world_lidar = np.array([geometry.transform(geometry.yaw(0.1 * k), [0.5 * k, 0.0, 0.0]) for k in range(10)])
    odometry = GivenOdometry(Trajectory(np.arange(10), stamps_ns, T_world_lidar), CONFIG, match="stamp")
    points = _room(np.random.default_rng(0), 30)
    stamps = (0, 10_000_000, 32_500_000, 99_000_000)
    found = [odometry.register(_scan(points, index=7, stamp_ns=stamp)).T_odom_lidar for stamp in stamps]
    np.testing.assert_array_equal(found[:2], T_world_lidar[:2])
    assert geometry.angle(found[2]) == pytest.approx(0.325)
    np.testing.assert_allclose(found[2][:2, 3], [1.625, 0.0], atol=6e-3)  # beside the chord, on an arc
    np.testing.assert_allclose(found[3], T_world_lidar[9])


@pytest.mark.parametrize("match", ["scan_index", "stamp"])
def test_a_scan_without_a_given_pose_is_a_bad_scan(match: str) -> None:
    points = _room(np.random.default_rng(0), 30)
    odometry = GivenOdometry(_trajectory(np.array([np.eye(4)])), CONFIG, match=match)
    with pytest.raises(BadScan, match=r"scan 5: .* no pose"):
        odometry.register(_scan(points, index=5, stamp_ns=50_000_000))
    empty = GivenOdometry(_trajectory(np.empty((0, 4, 4))), CONFIG, match=match)
    with pytest.raises(BadScan, match="it has none"):
        empty.register(_scan(points))


def test_a_scan_without_a_point_in_range_is_a_bad_scan_and_the_next_one_is_registered() -> None:
    points = _room(np.random.default_rng(0))
    odometry = KissOdometry(CONFIG)
    odometry.register(_scan(points))
    with pytest.raises(BadScan, match=r"scan 1: none of its 1 points lies between 3\.0 and 100\.0 m"):
        odometry.register(_scan(np.array([[1.0, 1.0, 1.0]]), index=1))
    assert geometry.distance(odometry.register(_scan(points, index=2)).T_odom_lidar) < 0.05


@pytest.mark.data
def test_ten_real_scans_end_at_the_reference(data_dir: Path, real_pairs: object) -> None:
    (T_10_0,) = [pair.T_target_source for pair in real_pairs.pairs if (pair.source, pair.target) == (0, 10)]
    odometry = KissOdometry(CONFIG)
    for index in range(11):
        result = odometry.register(_scan(real_pairs.points(index), index=index))
    error = T_10_0 @ result.T_odom_lidar
    assert geometry.distance(error) < 0.10, "the bound asked of the map command"
    assert np.degrees(geometry.angle(error)) < 0.3
    assert len(result.points) == len(result.labels) > 100_000


def _street(num_scans: int) -> list[Scan]:
    """Scans among posts along a street, a metre and a half apart, every other one with times."""
    rng = np.random.default_rng(5)
    posts = rng.uniform(-1.0, 1.0, (240, 2)) * [50.0, 10.0] + [30.0, 0.0]
    world = np.column_stack([np.repeat(posts, 60, axis=0), rng.uniform(-1.7, 3.0, 60 * len(posts))])
    scans = []
    for index in range(num_scans):
        seen = rng.permutation(geometry.apply(_forward(-1.5 * index), world))[:8_000]
        times = np.linspace(0.0, 1.0, len(seen)) if index % 2 else None
        scans.append(_scan(seen, index=index, times=times))
    return scans


def test_a_sweep_whose_seam_has_no_returns_is_not_stretched() -> None:
    """Returns from an eighth to seven eighths of the sweep move by their own share of the motion."""
    times = np.linspace(0.125, 0.875, 400)
    points = np.random.default_rng(0).uniform(5.0, 20.0, (400, 3)).astype(np.float32)
    T_last_lidar = geometry.transform(np.eye(3), [1.0, 0.0, 0.0])
    scan = _scan(points, times=times)
    moved = deskew_scan(scan, T_last_lidar, OdometryConfig())[0]
    np.testing.assert_allclose(moved[:, 0] - points[:, 0], times - 1.0, atol=1e-5)
    np.testing.assert_allclose(moved[:, 1:], points[:, 1:], atol=1e-5)


@pytest.mark.parametrize("first", [0.0, 0.6])
def test_the_motion_during_a_sweep_does_not_depend_on_that_by_which_its_points_were_moved_before(first: float) -> None:
    """A sensor that accelerates; the ends of its sweeps are off, because their points were moved by wrong motions.

    It may see points only late in each sweep.
    """
    rng = np.random.default_rng(2)
    scan = _scan(np.ones((50, 3)), times=np.linspace(first, 1.0, 50))
    sweeps, end, step = SweepMotion(), 1.0 - np.mean(scan.times), _forward(2.0)
    for time in range(1, 14):
        T_true_sweep = _forward(0.2 * (time - end))
        T_odom_middle = at_middle(scan, _forward(0.1 * time**2), T_true_sweep)
        T_wrong = geometry.exp(0.3 * rng.standard_normal(6))
        T_odom_lidar = T_odom_middle @ geometry.inverse(at_middle(scan, np.eye(4), T_wrong))
        found = sweeps.motion(at_middle(scan, T_odom_lidar, T_wrong), 1.0)
        if time > 8:  # the acceleration is known then
            assert found is not None
            np.testing.assert_allclose(found, T_true_sweep, atol=1e-6)
        sweeps.note(at_middle(scan, T_odom_lidar, T_wrong), 1.0, is_break=False)
    jump = geometry.transform(geometry.yaw(1.0), [40.0, 0.0, 0.0])
    sweeps.note(T_odom_lidar @ jump, 1.0, is_break=True)
    after = sweeps.motion(T_odom_lidar @ jump @ step, 1.0)
    assert after is not None
    np.testing.assert_allclose(after, step, atol=1e-9)


def test_noise_of_the_poses_is_no_acceleration() -> None:
    """By the two last middles, the motion has the noise of both, 1.4 of that of a pose; by three of them 2.5."""
    rng = np.random.default_rng(3)
    sweeps, errors_m = SweepMotion(), []
    for time in range(60):
        T_odom_middle = geometry.transform(np.eye(3), [time, *(0.05 * rng.standard_normal(2))])
        found = sweeps.motion(T_odom_middle, 1.0)
        if found is not None and time > 10:
            errors_m.append(found[1:3, 3])
        sweeps.note(T_odom_middle, 1.0, is_break=False)
    assert np.std(errors_m) < 1.7 * 0.05


def test_no_motion_during_the_first_sweep_is_known() -> None:
    assert SweepMotion().motion(_forward(1.0), 1.0) is None
