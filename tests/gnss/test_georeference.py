"""Drives placed on the globe by good and bad fixes."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.gnss_drive import ORIGIN, SIGMA_M, T_ENU_MAP, motions

from segslam.core import geometry
from segslam.core.trajectory import Poses
from segslam.core.types import Points, SegslamError
from segslam.gnss import Drive, Fixes, Origin, Use, enu_from_geodetic, geodetic_from_enu, georeference, utm_epsg
from segslam.gnss.alignment import place
from segslam.gnss.fixes import Row, make_fixes
from segslam.gnss.fusion import _windows
from segslam.gnss.matching import prepare

NUM, STEP_M, PERIOD_S = 240, 2.0, 1.0


def _truth() -> Poses:
    """Two rounds of a block, 480 m."""
    angle = 2.0 * np.pi * np.arange(NUM) / (NUM / 2)
    places = np.column_stack([60.0 * np.sin(angle), 45.0 * (1.0 - np.cos(angle)), 0.0 * angle])
    steps = np.gradient(places, axis=0)
    return np.stack(
        [geometry.transform(geometry.yaw(np.arctan2(y, x)), at) for (x, y, _), at in zip(steps, places, strict=True)]
    )


def _drifted(truth: Poses, share: float, seed: int = 0) -> Poses:
    """The same drive with errors of every motion."""
    rng = np.random.default_rng(seed)
    poses = [truth[0]]
    for before, after in pairwise(truth):
        noise = geometry.exp(share * SIGMA_M * rng.standard_normal(6))
        poses.append(poses[-1] @ geometry.inverse(before) @ after @ noise)
    return np.stack(poses)


def _drive(poses: Poses) -> Drive:
    return Drive(np.arange(NUM) * round(1e9 * PERIOD_S), poses, np.arange(NUM))


def _fixes(truth: Poses, *, sigma_m: float = 0.3, off_m: Points | float = 0.0, origin: Origin = ORIGIN) -> Fixes:
    noise = sigma_m * np.random.default_rng(1).standard_normal((NUM, 3))
    places = geodetic_from_enu(geometry.apply(T_ENU_MAP, truth[:, :3, 3]) + noise + off_m, origin)
    return make_fixes("fixes", [Row(round(1e9 * PERIOD_S * row), *place) for row, place in enumerate(places)])


def _error_m(found: object, truth: Poses, origin: Origin = ORIGIN) -> float:
    """Horizontal error on the globe, rms."""
    assert hasattr(found, "T_enu_keyframe")
    places = geodetic_from_enu(found.T_enu_keyframe[:, :3, 3], found.origin)
    off = enu_from_geodetic(places, origin) - geometry.apply(T_ENU_MAP, truth[:, :3, 3])
    return float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1))))


def test_a_good_drive_is_placed_and_keeps_its_shape() -> None:
    truth = _truth()
    found = georeference(motions(truth), _drive(truth), _fixes(truth), use=Use.ALIGN)
    assert _error_m(found, truth) < 0.15
    assert found.heading_sigma_deg < 1.0
    np.testing.assert_allclose(found.T_enu_keyframe, found.T_enu_map @ truth, atol=1e-9)
    assert found.num_kept > 0.9 * NUM
    assert found.fix_sigma_m[0] == pytest.approx(0.3, rel=0.3)


@pytest.mark.long
def test_a_drifted_drive_is_bent_by_good_fixes() -> None:
    truth = _truth()
    drifted = _drifted(truth, 0.15)
    aligned, fused = (
        georeference(motions(drifted), _drive(drifted), _fixes(truth, sigma_m=0.05), use=use) for use in Use
    )
    assert _error_m(aligned, truth) > 0.8
    assert _error_m(fused, truth) < 0.3 * _error_m(aligned, truth)
    assert fused.is_bent[0]


@pytest.mark.long
@pytest.mark.parametrize("first", [20, pytest.param(150, marks=pytest.mark.slow)])
def test_a_run_of_wrong_fixes_is_not_kept_and_does_no_harm(first: int) -> None:
    truth = _truth()
    off = np.zeros((NUM, 3))
    off[first : first + 60] = [25.0, -20.0, 0.0]
    found = georeference(motions(truth), _drive(truth), _fixes(truth, off_m=off))
    assert _error_m(found, truth) < 0.3
    wrong = set(found.reasons[first : first + 60])
    assert wrong == {"contradicts_drive"}
    assert found.reasons.count("contradicts_drive") < 75


def _later(fixes: Fixes, seconds: float) -> Fixes:
    return replace(fixes, stamp_ns=fixes.stamp_ns + round(1e9 * seconds))


@pytest.mark.long
def test_a_clock_that_is_off_is_measured() -> None:
    truth = _truth()
    found = georeference(motions(truth), _drive(truth), _later(_fixes(truth, sigma_m=0.05), 0.5))
    assert found.measured_offset_s == pytest.approx(-0.5, abs=0.05)
    assert _error_m(found, truth) < 0.2


def test_fixes_that_cannot_place_a_drive_are_refused_with_the_reason() -> None:
    truth = _truth()
    drive, edges = _drive(truth), motions(truth)
    fixes = _fixes(truth)
    rows = [Row(int(fixes.stamp_ns[row]), *fixes.places[row]) for row in range(3)]
    with pytest.raises(SegslamError, match="3 usable fixes are within the drive; at least 4"):
        georeference(edges, drive, make_fixes("three", rows))
    with pytest.raises(SegslamError, match=r"--gnss-offset -86400\.0"):
        georeference(edges, drive, _later(fixes, 86400.0))
    with pytest.raises(SegslamError, match="heading"):
        georeference(edges, drive, replace(fixes, places=fixes.places[[0] * NUM]))
    equal = make_fixes("equal", [Row(int(stamp_ns), *fixes.places[0]) for stamp_ns in fixes.stamp_ns])
    with pytest.raises(SegslamError, match="1 usable fixes are within the drive"):
        georeference(edges, drive, equal)


@pytest.mark.parametrize(("step_m", "first", "sigma_m"), [(0.2, 0, 26.0), (2.0, NUM - 15, 5.0)])
def test_a_heading_that_the_fixes_alone_do_not_determine_is_refused(step_m: float, first: int, sigma_m: float) -> None:
    """The errors of the fixes allow 5 degrees and more, and the fixes may be far from the first keyframe."""
    poses = np.stack([geometry.transform(np.eye(3), [step_m * row, 0.0, 0.0]) for row in range(NUM)])
    spread_m = step_m * np.std(np.arange(first, NUM))
    heading_deg = np.degrees(sigma_m / (np.sqrt(NUM - first) * spread_m))
    assert heading_deg > 5.0
    fixes = _fixes(poses, sigma_m=sigma_m)
    rows = [Row(int(fixes.stamp_ns[row]), *fixes.places[row]) for row in range(first, NUM)]
    with pytest.raises(SegslamError, match="the fixes determine the heading of the map to") as raised:
        place(prepare(make_fixes("fixes", rows), _drive(poses)))
    found_deg = float(str(raised.value).split(" degrees only")[0].rpartition(" ")[2])
    assert found_deg == pytest.approx(heading_deg, rel=0.4)


@pytest.mark.long
@pytest.mark.parametrize("num", [4, 6])
def test_the_error_of_the_heading_is_not_claimed_too_small_with_few_fixes(num: int) -> None:
    """60 m of drive, 0.3 m of noise."""
    times = np.arange(num) * round(5e9)
    poses = np.stack([geometry.transform(np.eye(3), [60.0 * row / (num - 1), 0.0, 0.0]) for row in range(num)])
    normal = []
    for seed in range(150):
        noise = 0.3 * np.random.default_rng(seed).standard_normal((num, 3))
        places = geodetic_from_enu(poses[:, :3, 3] + noise, ORIGIN)
        rows = [Row(int(stamp_ns), *at) for stamp_ns, at in zip(times, places, strict=True)]
        found = place(prepare(make_fixes("few", rows), Drive(times, poses, np.arange(num))))
        heading_rad = np.arctan2(found.T_enu_map[1, 0], found.T_enu_map[0, 0])
        normal.append(np.degrees(heading_rad) / found.heading_sigma_deg)
    assert 0.7 < np.sqrt(np.mean(np.square(normal))) < 1.5


@pytest.mark.long
@pytest.mark.parametrize(
    "longitude", [179.9999, *(pytest.param(one, marks=pytest.mark.slow) for one in (11.9999, -180.0))]
)
def test_a_drive_across_the_edge_of_a_zone_or_the_date_line_is_placed(longitude: float) -> None:
    """One zone, that of the origin, is used for the whole map."""
    truth, origin = _truth(), Origin(17.0, longitude, 5.0)
    fixes = _fixes(truth, origin=origin)
    zones = {utm_epsg(*place) for place in fixes.places[:, :2].tolist()}
    assert len(zones) == 2
    found = georeference(motions(truth), _drive(truth), fixes)
    assert _error_m(found, truth, origin) < 0.3
    assert found.num_kept > 0.9 * NUM


@pytest.mark.parametrize(("first", "last", "share"), [(0, 0, 1 / 6), (80, 140, 1 / 3), (0, 80, 0.5), (40, 220, 0.5)])
def test_held_out_windows_are_as_long_as_the_longest_part_without_fixes(first: int, last: int, share: float) -> None:
    """`first` to `last` of the fixes are wrong; each window is a share of all, and the windows reach both ends."""
    truth = _truth()
    off = np.zeros((NUM, 3))
    off[first:last] = [25.0, -20.0, 0.0]
    placement = place(prepare(_fixes(truth, sigma_m=0.05, off_m=off), _drive(truth)))
    good = np.ones(NUM, dtype=bool)
    good[first:last] = False
    windows = _windows(placement, good)
    assert [window.stop - window.start for window in windows] == pytest.approx([share * NUM] * 6, abs=0.03 * NUM)
    assert (windows[0].start, windows[-1].stop) == (0, NUM)


def test_held_out_windows_compare_travels_of_the_same_poses() -> None:
    """Four scans a keyframe, and the sensor shakes between them: the last quarter has no fixes."""
    many = 4 * NUM
    shaken = np.column_stack([np.linspace(0.0, 480.0, many), 0.5 * (np.arange(many) % 4 == 1), np.zeros(many)])
    poses = np.stack([geometry.transform(np.eye(3), place) for place in shaken])
    keyframes = np.arange(0, many, 4)
    drive = Drive(np.arange(many) * 250_000_000, poses, keyframes)
    placement = place(prepare(_fixes(poses[keyframes]), drive))
    good = np.arange(len(placement.matched.rows)) < 180
    windows = _windows(placement, good)
    assert [window.stop - window.start for window in windows] == pytest.approx([NUM / 3] * 6, abs=0.03 * NUM)


def test_the_speed_at_the_ends_of_a_drive_is_that_between_its_scans() -> None:
    poses = np.stack([geometry.transform(np.eye(3), [STEP_M * row, 0.0, 0.0]) for row in range(NUM)])
    matched = prepare(_fixes(poses), _drive(poses)).matched(0.0)
    np.testing.assert_allclose(matched.velocity, np.tile([STEP_M / PERIOD_S, 0.0, 0.0], (NUM, 1)), atol=1e-9)


def test_fixes_without_heights_place_a_drive_horizontally() -> None:
    truth = _truth()
    fixes = _fixes(truth)
    places = fixes.places.copy()
    places[:, 2] = np.nan
    found = georeference(motions(truth), _drive(truth), replace(fixes, places=places))
    assert _error_m(found, truth) < 0.3
    assert not np.isfinite(found.position_sigma_m[2])


def test_fixes_that_contradict_each_other_are_refused() -> None:
    truth = _truth()
    off = np.zeros((NUM, 3))
    rng = np.random.default_rng(0)
    for first in range(0, NUM, 10):
        off[first : first + 6, :2] = rng.uniform(-400.0, 400.0, 2)
    with pytest.raises(SegslamError, match="fixes: the fixes contradict each other"):
        georeference(motions(truth), _drive(truth), _fixes(truth, off_m=off))


def test_a_fix_belongs_to_a_keyframe_that_no_break_separates_from_it() -> None:
    """A sensor stands for some seconds before a break: the keyframe after it is nearer in time, but elsewhere."""
    stamp_ns = 1_000_000_000 * np.arange(10)
    fixes = make_fixes("fixes", [Row(int(stamp), 48.0, 8.0 + 1e-6 * row) for row, stamp in enumerate(stamp_ns)])
    drive = Drive(stamp_ns, np.tile(np.eye(4), (10, 1, 1)), np.array([0, 8]))
    np.testing.assert_array_equal(prepare(fixes, drive).matched(0.0).keyframe, 5 * [0] + 5 * [1])
    parted = replace(drive, breaks=[8])
    np.testing.assert_array_equal(prepare(fixes, parted).matched(0.0).keyframe, 8 * [0] + 2 * [1])
