import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.drives import round_drive
from helpers.rooms import ground_and_walls

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.threads import Stopwatch
from segslam.core.types import Alignment, Label, Registration, Rejected, RejectReason, SegslamError
from segslam.registration import refinement, segregator
from segslam.registration.free_space import FreeSpace
from segslam.registration.prepared import PreparedScan, prepare_scan
from segslam.scans import open_dataset
from segslam.verification import patches, register, register_near, register_prepared, rivals, score
from segslam.verification.pair import tried_poses
from segslam.verification.trial import FEW_NATS, MAX_COARSE_FINE_M, MAX_HYPOTHESES, Found, Trial, anywhere
from tools.benchmarks.altered import ALTERATIONS

CONFIG = Config()


def _error(T_a: np.ndarray, T_b: np.ndarray) -> tuple[float, float]:
    T = geometry.inverse(T_a) @ T_b
    return geometry.distance(T), float(np.degrees(geometry.angle(T)))


def _round_pair() -> tuple[PreparedScan, PreparedScan, np.ndarray]:
    scans, truth = round_drive()
    source, target = (prepare_scan(scans[i].points, scans[i].labels, config=CONFIG) for i in (3, 0))
    return source, target, geometry.inverse(truth.T_world_lidar[0]) @ truth.T_world_lidar[3]


def test_a_stopwatch_can_be_sent_to_another_process() -> None:
    watch = Stopwatch()
    watch.add("refine", 0.5)
    sent = pickle.loads(pickle.dumps(watch))
    sent.add("refine", 0.25)
    assert (watch.seconds, sent.seconds) == ({"refine": 0.5}, {"refine": 0.75})


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


def test_labels_of_another_number_are_refused() -> None:
    points = round_drive()[0][0].points
    with pytest.raises(SegslamError, match=f"3 labels for {len(points)} points"):
        register(points, points, target_labels=np.zeros(3, np.uint8))


def test_a_gate_rejects_a_coarse_pose_before_it_is_refined() -> None:
    source, target, _ = _round_pair()
    watch = Stopwatch()
    no = Rejected(RejectReason.FAR_FROM_PRIOR)
    assert register_prepared(source, target, config=CONFIG, gate=lambda pose, *, slack_m: no, watch=watch) is no
    assert set(watch.seconds) == {"match"}


def test_a_gate_sees_the_refined_pose_too_which_moves_no_farther() -> None:
    source, target, T_target_source = _round_pair()
    seen: list[tuple[float, float]] = []

    def gate(pose: np.ndarray, *, slack_m: float) -> Rejected | None:
        seen.append((slack_m, _error(T_target_source, pose)[0]))
        return Rejected(RejectReason.FAR_FROM_PRIOR, "refined") if slack_m == 0.0 else None

    found = register_prepared(source, target, config=CONFIG, gate=gate)
    assert isinstance(found, Rejected)
    assert found.detail == "refined"
    slack_m, error_m = zip(*seen, strict=True)
    assert slack_m[0] == MAX_COARSE_FINE_M
    assert error_m[slack_m.index(0.0)] < 0.05


def test_a_pose_ends_the_search_only_if_it_is_probable_and_the_prior_allows_it() -> None:
    source, target, T_target_source = _round_pair()
    no = Rejected(RejectReason.FAR_FROM_PRIOR)
    free, excluding = (
        Trial(source, target, CONFIG, gate, Stopwatch())
        for gate in (anywhere, lambda pose, *, slack_m: no if slack_m == 0.0 else None)
    )
    coarse = Registration(T_target_source, 3, 3, 0.1, np.eye(6))
    right = free.found(coarse, coarse)
    T_off = T_target_source @ geometry.transform(np.eye(3), np.array([0.0, 1.5, 0.0]))
    wrong = free.found(coarse, replace(coarse, T_target_source=T_off))
    assert free.fits(right)
    assert not free.fits(wrong)
    assert not excluding.fits(right)


def test_poses_that_the_prior_excludes_do_not_use_up_the_attempts(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a corridor, where the poses that fit best are turned round."""
    source, target, T_target_source = _round_pair()
    (right, *_) = segregator.hypotheses(source.description, target.description, config=CONFIG.segregator)
    turned = replace(right, T_target_source=right.T_target_source @ geometry.transform(geometry.yaw(np.pi), 0.0))
    ranked = [turned] * MAX_HYPOTHESES + [right]
    monkeypatch.setattr(segregator, "hypotheses", lambda *_, **__: ranked)
    monkeypatch.setattr("segslam.verification.trial.MAX_PLAN_HYPOTHESES", 0)

    def gate(pose: np.ndarray, *, slack_m: float) -> Rejected | None:
        turn_deg = _error(T_target_source, pose)[1]
        return Rejected(RejectReason.FAR_FROM_PRIOR) if turn_deg > 20.0 else None

    assert isinstance(register_prepared(source, target, config=CONFIG, gate=gate), Alignment)


def test_in_a_first_look_the_patches_of_the_source_stand_for_those_of_the_target(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source, target, _ = _round_pair()
    (coarse, *_) = segregator.hypotheses(source.description, target.description, config=CONFIG.segregator)
    trial = Trial(source, target, CONFIG, anywhere, Stopwatch())
    least = trial.least_odds - FEW_NATS

    def odds(num_fitting: int) -> float:
        return score.shipped().log_odds(patches.counted(np.full(num_fitting, patches.RESIDUAL, np.int8)))

    enough = next(number for number in range(1, 400) if odds(2 * number) >= least)
    assert odds(enough) < least
    for number, is_hopeless in ((enough - 1, True), (enough, False)):
        shown = np.full(number, patches.RESIDUAL, np.int8)
        monkeypatch.setattr(Trial, "first_look", lambda self, T_target_source, shown=shown: shown)
        assert isinstance(trial.begin(coarse), Rejected) is is_hopeless


def test_poses_that_the_prior_excludes_are_rivals() -> None:
    """A yard that looks the same turned by 180 degrees; the prior excludes the pose that is turned."""
    points, labels = ground_and_walls()
    rng = np.random.default_rng(0)
    source, target = (
        prepare_scan((points + rng.normal(0.0, 0.03, points.shape)).astype(np.float32), labels, config=CONFIG)
        for _ in range(2)
    )

    def gate(pose: np.ndarray, *, slack_m: float) -> Rejected | None:
        return Rejected(RejectReason.FAR_FROM_PRIOR) if geometry.angle(pose) > 0.5 else None

    found = register_prepared(source, target, config=CONFIG, gate=gate)
    assert isinstance(found, Rejected)
    assert found.reason is RejectReason.AMBIGUOUS
    assert found.probability is not None
    assert found.probability < 0.999
    assert found.evidence["other_pose"] < -5.0


def test_shifts_that_others_led_past_are_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refinement that leads to the next multiple of 3 m below: 6 from 8 m, 3 from 5 m, 0 from 2 m."""
    tried: list[float] = []

    def led(coarse: Registration, *_: object) -> rivals._Start:
        tried.append(float(coarse.T_target_source[0, 3]))
        T_led = geometry.transform(np.eye(3), [tried[-1] // 3 * 3.0, 0.0, 0.0])
        return rivals._Start(replace(coarse, T_target_source=T_led), 0.0)

    monkeypatch.setattr(rivals, "_led", led)
    trial, found = _found_pose()
    found = found._replace(fine=Registration(np.eye(4), 1, 1, 0.1, np.eye(6)))
    ends = [start.coarse.T_target_source[0, 3] for start in rivals._shifted(found, np.array([1.0, 0.0, 0.0]), trial)]
    assert tried == [8.0, 5.0, 2.0]
    assert ends == [6.0, 3.0, 0.0]


@pytest.mark.parametrize(("off_m", "is_found"), [(0.4, True), (2.5, False)])
def test_near_a_known_pose_no_others_are_tried(off_m: float, is_found: bool) -> None:
    source, target, T_target_source = _round_pair()
    T_known = T_target_source @ geometry.transform(np.eye(3), [off_m, 0.0, 0.0])
    found = register_near(source, target, T_known, config=CONFIG, watch=Stopwatch())
    assert isinstance(found, Alignment) == is_found
    if isinstance(found, Alignment):
        assert _error(T_target_source, found.fine.T_target_source)[0] < 0.05
        assert "other_pose" not in found.evidence


@pytest.mark.parametrize(("beside_m", "least", "num_refined", "leads"), [(0.9, 0, 1, True), (0.9, 99, 0, False)])
def test_the_first_iterations_decide_whether_a_rival_is_refined(
    beside_m: float, least: int, num_refined: int, leads: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pose from which refinement starts is beside the one to which it leads; `least` is added to its lead."""
    trial, found = _found_pose()
    monkeypatch.setattr(refinement, "is_near", lambda *_: False)
    lead = rivals._lead
    monkeypatch.setattr(rivals, "_lead", lambda *given: lead(*given) + least)
    refined = []
    refine = refinement.refine
    monkeypatch.setattr(refinement, "refine", lambda *given, **named: refined.append(1) or refine(*given, **named))
    T_beside = found.T_target_source @ geometry.transform(np.eye(3), [beside_m, 0.0, 0.0])
    led = rivals._led(replace(found.coarse, T_target_source=T_beside), found, trial)
    assert (led is not None, len(refined)) == (leads, num_refined)


def test_floor_plans_of_two_pairs_at_the_same_time_are_searched_once(monkeypatch: pytest.MonkeyPatch) -> None:
    source, target, _ = _round_pair()
    trials = [Trial(*scans, CONFIG, anywhere, Stopwatch()) for scans in ((source, target), (target, source))]
    searched, search = [], segregator.plan_hypotheses
    monkeypatch.setattr(
        segregator, "plan_hypotheses", lambda *given, **named: searched.append(1) or search(*given, **named)
    )
    first, second = ([one.plans_near() for one in trials] for _ in range(2))
    assert len(searched) == 2
    assert [len(plans) for plans in first] == [len(plans) for plans in second] != [0, 0]


def _found_pose() -> tuple[Trial, Found]:
    source, target, _ = _round_pair()
    trial = Trial(source, target, CONFIG, anywhere, Stopwatch())
    (coarse, *_) = (one for one in trial.coarse_poses() if isinstance(one, Registration))
    found = trial.refined(coarse, coarse.T_target_source)
    assert isinstance(found, Found)
    return trial, found


def test_moving_classes_are_in_neither_surface_nor_free_space() -> None:
    points = round_drive()[0][0].points
    labels = np.full(len(points), Label.BUILDING, dtype=np.uint8)
    ahead = points[:, 0] > 0.0
    moving = prepare_scan(points, np.where(ahead, np.uint8(Label.MOVING_CAR), labels), config=CONFIG)
    without = prepare_scan(points[~ahead], labels[~ahead], config=CONFIG)
    assert moving.surface.points[:, 0].max() < 0.5
    np.testing.assert_array_equal(moving.surface.points, without.surface.points)
    np.testing.assert_array_equal(moving.free_space.nearest_m, without.free_space.nearest_m)


def test_the_view_of_gathered_points_is_that_of_the_scan_in_their_middle() -> None:
    scans, _ = round_drive()
    gathered = np.concatenate([scans[0].points, scans[3].points])
    labels = np.full(len(gathered), Label.BUILDING, dtype=np.uint8)
    prepared = prepare_scan(gathered, labels, config=CONFIG, seen_from_here=scans[0].points)
    np.testing.assert_array_equal(prepared.free_space.nearest_m, FreeSpace(scans[0].points).nearest_m)
    assert len(prepared.surface) > len(prepare_scan(scans[0].points, scans[0].labels, config=CONFIG).surface)


@pytest.mark.parametrize(
    "points", [np.empty((0, 3)), np.zeros((50, 3)), np.column_stack([np.linspace(5, 50, 500), np.zeros((500, 2))])]
)
def test_scans_without_usable_points_are_rejected(points: np.ndarray) -> None:
    labels = np.ones(len(points), dtype=np.uint8)
    assert isinstance(register(points, points, source_labels=labels, target_labels=labels), Rejected)
    assert isinstance(register(points, points), Rejected)


@pytest.mark.parametrize(("shift_m", "scale"), [(1e6, 1.0), (0.0, 1000.0), (0.0, 0.0)])
def test_coordinates_of_a_map_or_in_millimetres_are_too_few_points(shift_m: float, scale: float) -> None:
    scans, _ = round_drive()
    outcome = register(scale * scans[0].points + [shift_m, 0.0, 0.0], scans[1].points)
    assert isinstance(outcome, Rejected)
    assert outcome.reason is RejectReason.TOO_FEW_POINTS
    assert "points within 60 m, 100 needed" in outcome.detail


@pytest.mark.parametrize("is_better", [True, False])
def test_a_rival_that_does_not_converge_where_it_is_rivals_but_is_not_returned(
    is_better: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target, T_true = _round_pair()
    begun: list[np.ndarray] = []
    refined = Trial.refined

    def noted(self: Trial, coarse: Registration, T_begun: np.ndarray, **options: bool) -> Found | Rejected:
        begun.append(T_begun)
        return refined(self, coarse, T_begun, **options)

    def far(found: Found, known: object, trial: Trial) -> list[Found]:
        T_target_source = geometry.transform(np.eye(3), [0.0, 0.0, 30.0]) @ found.T_target_source
        return [found._replace(fine=replace(found.fine, T_target_source=T_target_source))]

    monkeypatch.setattr("segslam.verification.pair.rivals_of", far)
    sign = 1.0 if is_better else -1.0
    monkeypatch.setattr(Found, "mean_ratio", property(lambda pose: sign * pose.T_target_source[2, 3]))
    monkeypatch.setattr(Trial, "refined", noted)
    tried = tried_poses(Trial(source, target, CONFIG, anywhere, Stopwatch()))
    assert not isinstance(tried, Rejected)
    assert _error(T_true, tried[0].T_target_source)[0] < 0.05
    assert [_error(T_true, other.T_target_source)[0] > 29.0 for other in tried[1:]].count(True) == 1
    assert any(T_begun[2, 3] > 29.0 for T_begun in begun) == is_better, "only what may be returned is refined on"


@pytest.mark.data
def test_a_pose_that_slides_along_a_wall_rivals_another_on_the_wall(data_dir) -> None:
    """Two scans of a courtyard, cut to a view of 40 degrees, see one wall; a pose 6.6 m along it fits as well."""
    drive = open_dataset(data_dir / "courtyard")
    cut = [ALTERATIONS["view-40"].points(drive[row].points.astype(float), row).astype(np.float32) for row in (85, 82)]
    outcome = register(*cut)
    assert isinstance(outcome, Rejected), outcome
    assert outcome.reason == RejectReason.AMBIGUOUS


@pytest.mark.data
def test_real_scans_of_different_places_are_rejected(real_pairs) -> None:
    outcomes = [
        register(real_pairs.points(source), real_pairs.points(target))
        for source, target in ((94, 0), (198, 4413), (95, 199), (30, 198))
    ]
    assert all(isinstance(outcome, Rejected) for outcome in outcomes), outcomes
