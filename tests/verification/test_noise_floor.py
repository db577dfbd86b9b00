import numpy as np
from helpers.streets import corner

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import Label, Transform
from segslam.registration.prepared import prepare_scan
from segslam.verification.gates import SINGLE_PAIR, Observed
from segslam.verification.noise_floor import EVERY, MIN_PAIRS, NUM_FIRST, NeighbourNoise

CONFIG = Config()


class _Drive:
    """Scans of one place, neighbours 1 m apart; records which are requested."""

    def __init__(self, sigma_m: float, *, slip_m: float = 0.0) -> None:
        rng = np.random.default_rng(5)
        cloud = corner(rng)
        labels = np.full(len(cloud), Label.BUILDING, dtype=np.uint8)
        noisy = [cloud - [x, 0.0, 0.0] + rng.normal(scale=sigma_m, size=cloud.shape) for x in (0.0, 1.0)]
        self._scans = [prepare_scan(points, labels, config=CONFIG) for points in noisy]
        self._slip_m = slip_m
        self.asked: list[int] = []

    def observed(self, keyframe_id: int) -> Observed:
        self.asked.append(keyframe_id)
        return self._scans[keyframe_id % 2].observed

    def odometry(self, keyframe_id: int) -> Transform:
        return geometry.transform(np.eye(3), [keyframe_id % 2 * (1.0 + self._slip_m), 0.0, 0.0])

    def noise(self) -> NeighbourNoise:
        return NeighbourNoise(self.observed, self.odometry, config=CONFIG)


def test_the_first_loop_finds_pairs_from_all_along_the_drive_and_later_ones_few() -> None:
    drive = _Drive(0.02)
    noise = drive.noise()
    floor = noise.at(101)
    assert drive.asked[::2] == [1, 26, 51, 76, 101]
    assert floor.residual_ratio < 1.0
    assert floor.overlap > 0.9
    assert noise.at(101 + EVERY - 1) == floor
    assert len(drive.asked) == 2 * NUM_FIRST, "too early for another pair"
    noise.at(101 + EVERY)
    assert len(drive.asked) == 2 * NUM_FIRST + 2


def test_the_same_calls_give_the_same_floor() -> None:
    one, other = _Drive(0.05).noise(), _Drive(0.05).noise()
    assert [one.at(at) for at in (60, 70, 90)] == [other.at(at) for at in (60, 70, 90)]


def test_neighbours_are_ignored_where_odometry_failed() -> None:
    assert _Drive(0.02, slip_m=15.0).noise().at(101) == SINGLE_PAIR


def test_a_run_of_one_keyframe_has_the_floor_of_a_single_pair() -> None:
    drive = _Drive(0.02)
    assert drive.noise().at(0) == SINGLE_PAIR
    assert drive.asked == []


def test_too_short_a_drive_has_the_floor_of_a_single_pair() -> None:
    assert MIN_PAIRS > 2
    assert _Drive(0.02).noise().at(2) == SINGLE_PAIR
