import numpy as np
import pytest
from drives import round_drive

from segslam import geometry
from segslam.alignment import Stopwatch, align, prepare_scan, register
from segslam.config import Config
from segslam.types import Alignment, Rejected, RejectReason

CONFIG = Config()


def _error(T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    T = geometry.inverse(T_a) @ T_b
    return geometry.distance(T), float(np.degrees(geometry.angle(T)))


@pytest.mark.parametrize("turn_deg", [0, 90, 180])
def test_two_scans_of_a_place_are_aligned_from_any_yaw(turn_deg: float) -> None:
    scans, truth = round_drive()
    T_turned_source = geometry.transform(geometry.yaw(np.radians(turn_deg)), [0.0, 0.0, 0.0])
    source, target = scans[3], scans[0]
    found = register(
        geometry.apply(T_turned_source, source.points),
        target.points,
        source_labels=source.labels,
        target_labels=target.labels,
    )
    T_target_source = geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[3]
    assert isinstance(found, Alignment)
    metres, degrees = _error(T_target_source @ geometry.inverse(T_turned_source), found.fine.T_target_source)
    assert metres < 0.05
    assert degrees < 0.2


def test_a_gate_turns_a_coarse_pose_down_before_it_is_refined() -> None:
    scans, _ = round_drive()
    source, target = (prepare_scan(scans[i].points, scans[i].labels, config=CONFIG) for i in (3, 0))
    watch = Stopwatch()
    no = Rejected(RejectReason.FAR_FROM_PRIOR)
    assert align(source, target, config=CONFIG, gate=lambda coarse: no, watch=watch) is no
    assert set(watch.seconds) == {"match"}


@pytest.mark.parametrize(
    "points", [np.empty((0, 3)), np.zeros((50, 3)), np.column_stack([np.linspace(5, 50, 500), np.zeros((500, 2))])]
)
def test_scans_that_say_nothing_are_rejected(points: np.ndarray) -> None:
    labels = np.ones(len(points), dtype=np.uint8)
    assert isinstance(register(points, points, source_labels=labels, target_labels=labels), Rejected)
    assert isinstance(register(points, points), Rejected)


@pytest.mark.data
def test_real_scans_of_different_places_are_rejected(real_pairs) -> None:
    outcomes = [
        register(real_pairs.points(source), real_pairs.points(target))
        for source, target in ((94, 0), (198, 4413), (95, 199), (30, 198))
    ]
    assert all(isinstance(outcome, Rejected) for outcome in outcomes), outcomes
