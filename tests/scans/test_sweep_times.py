"""Times within a sweep, whatever the unit, the origin and the part of the sweep that has returns."""

from pathlib import Path

import numpy as np
import pytest

from segslam.scans.dataset import Cloud, make_scan
from segslam.scans.scan_files import sweep_of

SHARES = np.linspace(0.125, 0.875, 7)  # nothing is seen in the first and the last eighth of the turn


@pytest.mark.parametrize("unit_s", [1.0, 1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("period_s", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("origin", ["start", "end", "absolute", "absolute end"])
def test_a_sweep_without_returns_at_its_seam_is_not_stretched(unit_s: float, period_s: float, origin: str) -> None:
    stamp_s = 1.7e9
    start_s = {"start": 0.0, "end": -period_s, "absolute": stamp_s, "absolute end": stamp_s - period_s}[origin]
    times = (start_s + SHARES * period_s) / unit_s
    for counts_from_stamp in (True, False):
        sweep = sweep_of(times, 7, stamp_s, counts_from_stamp=counts_from_stamp)
        np.testing.assert_allclose(sweep.times, SHARES, atol=1e-5)  # 1.7e9 s to 0.24 microseconds
        assert sweep.duration_s == pytest.approx(period_s)
        is_known = counts_from_stamp or origin.startswith("absolute")
        assert sweep.stamp_time == pytest.approx(0.0 if is_known and not origin.endswith("end") else 1.0, abs=1e-5)


def test_shares_of_a_sweep_stay_as_they_are() -> None:
    sweep = sweep_of(SHARES, 7, 0.0, counts_from_stamp=True)
    np.testing.assert_array_equal(sweep.times, SHARES)
    assert (sweep.duration_s, sweep.stamp_time) == (0.0, 1.0)


def test_times_that_fit_no_period_are_scaled_by_the_first_and_last_point() -> None:
    for times, expected_s, stamp_time in (([10.0, 20.0, 15.0], 0.01, 1.0), ([0.0, 66.4, 33.2], 0.0664, 0.0)):  # 15 Hz
        sweep = sweep_of(np.array(times), 3, 0.0, counts_from_stamp=True)
        np.testing.assert_allclose(sweep.times, [0.0, 1.0, 0.5])
        assert (sweep.duration_s, sweep.stamp_time) == pytest.approx((expected_s, stamp_time))


def test_a_full_sweep_begins_at_0_and_ends_within_the_period() -> None:
    times = np.linspace(0.0, 0.1008, 11)  # the sensor turns a little slower than it should
    shares = sweep_of(times, 11, 0.0, counts_from_stamp=False).times
    assert shares[0] == 0.0
    assert shares[-1] == 1.0


@pytest.mark.parametrize(
    ("times", "num_points"),
    [([], 3), ([0.0, 0.1], 3), ([0.05, 0.05, 0.05], 3), ([0.0, np.nan, 0.1], 3), ([], 0)],
)
def test_missing_times_give_none(times: list[float], num_points: int) -> None:
    assert len(sweep_of(np.array(times), num_points, 0.0, counts_from_stamp=True).times) == 0


@pytest.mark.parametrize("invalid", [0.0, np.nan, -1e30])
def test_times_of_points_without_return_do_not_matter(invalid: float) -> None:
    points = np.ones((8, 3), np.float32)
    points[[2, 5]] = [[np.nan, 1.0, 1.0], [0.0, 0.0, 0.0]]
    stamp_s = 1.7e9
    times = stamp_s + 0.1 * np.linspace(0.0, 0.999, 8)
    labels = np.zeros(8, np.uint8)
    expected = make_scan(Path("0.bin"), 0, round(1e9 * stamp_s), Cloud(points, times), labels).times
    times[[2, 5]] = invalid
    found = make_scan(Path("0.bin"), 0, round(1e9 * stamp_s), Cloud(points, times), labels)
    np.testing.assert_array_equal(found.times, expected)
    np.testing.assert_allclose(found.times, np.linspace(0.0, 0.999, 8)[[0, 1, 3, 4, 6, 7]], atol=1e-5)
    assert found.sweep_s == pytest.approx(0.1)
