"""Pairs, trials, rows and figures: all but the registrations themselves."""

import json
from collections.abc import Callable
from pathlib import Path
from time import sleep

import numpy as np
import pytest

from segslam.bench.experiments import job, paper, provenance
from segslam.bench.experiments.benchmark import run
from segslam.bench.experiments.job import Job, failed_row
from segslam.bench.experiments.method_settings import METHOD_NAMES
from segslam.bench.experiments.methods import Method
from segslam.bench.experiments.pairs import (
    PAPER_PAIR,
    PairList,
    ScanVariant,
    Trial,
    cut_pairs,
    pair_trials,
    read_pairs,
    sample_pairs,
    true_poses,
)
from segslam.bench.experiments.rows import Row, figures, read_rows, results, worst_failures, write_rows
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.threads import Stopwatch
from segslam.core.types import Rejected, RejectReason, SegslamError, Trajectory
from segslam.scans import DataSource


def drive(num_scans: int = 200) -> Trajectory:
    """Three rounds of a circle of 60 scans and a radius of 10 m."""
    angles = 2 * np.pi * np.arange(num_scans) / 60
    poses = np.stack([geometry.transform(geometry.yaw(a), [10 * np.cos(a), 10 * np.sin(a), 0.0]) for a in angles])
    numbers = np.arange(num_scans)
    return Trajectory(numbers, numbers * 100_000_000, poses)


def row(**values: object) -> Row:
    usual = {
        "pairs": "list",
        "source": 1,
        "target": 70,
        "source_yaw_deg": 0.0,
        "source_lost": 0.0,
        "target_lost": 0.0,
        "draw": 0,
        "method": "gicp",
        "accepted": True,
        "reason": "",
        "error_m": 0.1,
        "error_deg": 0.2,
        "ms": 10.0,
        "T_target_source": " ".join(f"{value:.17g}" for value in np.eye(4)[:3].ravel()),
    }
    return Row.model_validate(usual | values)


def test_a_list_is_cut_by_distance_and_gap_as_a_plain_loop_cuts_it() -> None:
    reference = drive()
    cut = cut_pairs(reference, name="cut", min_m=1.0, max_m=3.0, min_gap=50)
    at = reference.T_world_lidar[:, :3, 3]
    expected = [(i, j) for i in range(200) for j in range(i + 50, 200) if 1.0 <= np.linalg.norm(at[i] - at[j]) < 3.0]
    assert len(expected) > 100
    assert list(map(tuple, cut.pairs.tolist())) == expected


def test_a_sample_repeats_with_its_seed_and_keeps_the_order_of_the_list() -> None:
    whole = cut_pairs(drive(), name="cut", min_m=1.0, max_m=3.0)
    once, again, other = (sample_pairs(whole, num_pairs=20, seed=seed).pairs for seed in (3, 3, 4))
    np.testing.assert_array_equal(once, again)
    assert not np.array_equal(once, other)
    order = {tuple(pair): place for place, pair in enumerate(whole.pairs.tolist())}
    places = [order[tuple(pair)] for pair in once.tolist()]
    assert places == sorted(set(places))
    assert sample_pairs(whole, num_pairs=10**6, seed=0) is whole


def test_the_truth_of_a_pair_is_the_pose_of_the_source_in_the_target() -> None:
    reference = drive()
    T = true_poses(PairList("one", np.array([[3, 65]]), 1), reference)[3, 65]
    point_of_source = np.array([[1.0, 2.0, 0.5]])
    in_world = geometry.apply(reference.T_world_lidar[3], point_of_source)
    np.testing.assert_allclose(geometry.apply(reference.T_world_lidar[65] @ T, point_of_source), in_world)


def _posed(matrix: np.ndarray) -> str:
    """A list of one pair with this pose."""
    return json.dumps([{"source": 1, "target": 2, "T_target_source": matrix.tolist()}])


def test_lists_are_read_with_comments_and_json_brings_its_own_truth(tmp_path: Path) -> None:
    (tmp_path / "some.txt").write_text("# source target\n1 60\n\n2 61 0.5\n")
    assert read_pairs(tmp_path / "some.txt").pairs.tolist() == [[1, 60], [2, 61]]
    T = geometry.transform(geometry.yaw(0.3), [1.0, 2.0, 3.0])
    (tmp_path / "posed.json").write_text(json.dumps([{"source": 5, "target": 9, "T_target_source": T.tolist()}]))
    np.testing.assert_allclose(true_poses(read_pairs(tmp_path / "posed.json"), None)[5, 9], T)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.txt", "1 2\n3 x\n", "a.txt:2"),
        ("a.txt", "7\n", "a.txt:1"),
        ("a.txt", "\n", "contains no pairs"),
        ("a.json", "{}", "contains no pairs"),
        ("a.json", "[1", "a.json"),
        ("a.json", '[{"source": 1, "target": 2}]', "T_target_source"),
        ("a.json", _posed(np.diag([2.0, 1, 1, 1])), "a.json: .* is not a rigid transform"),
        ("a.json", _posed(np.diag([-1.0, 1, 1, 1])), "is not a rigid transform"),
        ("a.json", _posed(geometry.transform(np.eye(3), [np.nan, 0.0, 0.0])), "is not a rigid transform"),
        ("a.json", _posed(np.full((4, 4), np.inf)), "is not a rigid transform"),
        ("a.json", _posed(np.ones((4, 4))), "is not a rigid transform"),
    ],
)
def test_a_broken_list_is_named_with_the_line(tmp_path: Path, name: str, text: str, expected: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(SegslamError, match=expected):
        read_pairs(tmp_path / name)


def test_a_scan_that_is_missing_is_named() -> None:
    with pytest.raises(SegslamError, match="scan 500"):
        pair_trials(PairList("far", np.array([[1, 500]]), 1), drive())
    with pytest.raises(SegslamError, match="no true poses"):
        pair_trials(PairList("far", np.array([[1, 60]]), 1), None)


def test_the_truth_of_a_turned_source_carries_its_points_where_they_were() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3)) * 10
    reference = drive()
    turned = pair_trials(PAPER_PAIR, reference, step_deg=30)
    assert len(turned) == 12
    assert len({one.key for one in turned}) == 12
    for one in turned:
        seen = one.source.turned(points)
        T_true = geometry.inverse(reference.T_world_lidar[10]) @ reference.T_world_lidar[0]
        np.testing.assert_allclose(geometry.apply(one.T_target_source, seen), geometry.apply(T_true, points), atol=1e-9)


def test_labels_are_removed_in_the_given_share_independently_at_each_draw() -> None:
    labels = np.full(20_000, 13, np.uint8)
    lost = [ScanVariant(4, lost=0.3, draw=draw).remaining(labels) == 0 for draw in (0, 0, 1)]
    assert abs(lost[0].mean() - 0.3) < 0.02  # 6 standard deviations of a share of 20,000 draws
    np.testing.assert_array_equal(lost[0], lost[1])
    assert (lost[0] != lost[2]).mean() > 0.3
    kinds = {"lost_percent": [10.0, 90.0], "num_draws": 3, "seed": 1}
    both = pair_trials(PAPER_PAIR, drive(), **kinds, both=True)
    one = pair_trials(PAPER_PAIR, drive(), **kinds, both=False)
    assert len(both) == len(one) == 6
    assert {t.target.lost for t in both} == {0.1, 0.9}
    assert {t.target for t in one} == {ScanVariant(10)}
    assert {t.source.draw for t in one} == {3, 4, 5}


def test_without_lost_labels_there_is_one_draw_whose_row_is_that_of_the_trial() -> None:
    trials = pair_trials(PAPER_PAIR, drive(), lost_percent=[0.0, 50.0], num_draws=2, seed=3, both=True)
    assert [(trial.source.lost, trial.source.draw) for trial in trials] == [(0.0, 0), (0.5, 6), (0.5, 7)]
    assert [failed_row("gicp", trial, "").trial_key for trial in trials] == [trial.key for trial in trials]


def test_rows_come_back_from_their_file_but_for_a_line_that_was_cut_off(tmp_path: Path) -> None:
    rows = [row(), row(accepted=False, reason="small_clique", error_m=None, error_deg=None, T_target_source="")]
    file = tmp_path / "rows.csv"
    write_rows(file, rows)
    assert read_rows(file) == rows
    np.testing.assert_array_equal(rows[0].estimate, np.eye(4))
    assert rows[1].estimate is None
    text = file.read_text()
    file.write_text(text[:-20])
    assert read_rows(file) == rows[:1]
    file.write_text(text.replace("gicp,True", "gicp,perhaps"))
    with pytest.raises(SegslamError, match=r"rows.csv:2: accepted"):
        read_rows(file)


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match=r"missing"):
        write_rows(tmp_path / "missing" / "rows.csv", [row()])


def test_figures_count_successes_wrong_poses_and_rejections_apart() -> None:
    rejected = {"accepted": False, "reason": "small_clique", "error_m": None, "error_deg": None}
    rows = [
        row(ms=10.0, num_edges=100),
        row(ms=20.0, error_m=0.3, error_deg=0.4, num_edges=300),
        row(ms=30.0, error_m=3.0, num_edges=5),
        row(ms=40.0, error_deg=6.0, num_edges=3),
        row(ms=50.0, **rejected),
    ]
    found = figures(rows)
    assert found["success_percent"] == 40.0
    assert (found["num_pairs"], found["num_false_accepted"], found["num_rejected"]) == (5, 2, 1)
    assert found["translation_m"] == pytest.approx(0.2)
    assert found["rotation_deg"] == pytest.approx(0.3)
    assert found["median_ms"] == 30.0
    assert found["mean_edges"] == pytest.approx(102.0)
    assert figures([row(**rejected)])["translation_m"] is None
    assert [one.error_m for one in worst_failures(rows, 2)] == [3.0, 0.1]


def test_results_are_compared_with_the_paper_for_the_same_list_only() -> None:
    assert paper.success_percent("segregator", "kitti06_10to15", 2825) == 98.3
    assert paper.success_percent("segregator", "kitti06_10to15", 2824) is None  # another list under the same name
    assert paper.success_percent("gicp", "kitti06_10to15", 2825) is None
    assert paper.success_percent("segregator", "cut_10to15", 2825) is None
    found = results([row(method="segregator", pairs="kitti06_10to15")], by="list")
    sampled = PairList("kitti06_10to15", np.array([[1, 70]]), 2825)
    beside = paper.with_paper_values(found, experiment="pairs", sequence="06", lists=[sampled])
    assert beside["segregator"]["by"][0]["paper"] == {"success_percent": 98.3}


@pytest.mark.data
def test_the_paper_s_lists_have_as_many_pairs_as_its_table(data_dir: Path) -> None:
    assert len(paper.NUM_PAIRS) == 15
    for name, count in paper.NUM_PAIRS.items():
        assert len(read_pairs(data_dir / "pairs" / f"{name}.txt").pairs) == count


def test_conditions_in_a_report_contain_no_folder(tmp_path: Path) -> None:
    job = Job(DataSource(tmp_path, labels=str(tmp_path / "predicted")), METHOD_NAMES, Config())
    lists = [PairList("list", np.array([[1, 70]]), 9)]
    output = provenance.account("pairs", job, lists, results([row()], by="list"), options={"seed": 0})
    assert str(tmp_path.parent) not in json.dumps(output)
    assert any("SAMPLED: list 1 of 9" in note for note in output["notes"])
    assert output["packages"]["numpy"] == np.__version__
    assert not any("SIMULATED" in note for note in output["notes"])
    (tmp_path / "simulation.json").write_text('{"seed": 7}')
    notes = provenance.account("pairs", job, lists, {}, options={})["notes"]
    assert any("SIMULATED (seed 7)" in note for note in notes)
    assert not any("with true labels" in note for note in notes), "they are predicted"
    job = Job(DataSource(tmp_path), METHOD_NAMES, Config())
    notes = provenance.account("pairs", job, lists, {}, options={})["notes"]
    assert any("with true labels" in note for note in notes)


def test_the_first_registration_of_a_process_is_measured_like_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Stopwatch] = []

    def align(_source: object, _target: object, _config: Config, watch: Stopwatch) -> Rejected:
        calls.append(watch)
        sleep(0.3 if len(calls) == 1 else 0.0)  # modules are loaded
        return Rejected(RejectReason.TOO_FEW_POINTS)

    monkeypatch.setitem(job.METHODS, "loading", Method((), align))
    trial = Trial("list", ScanVariant(1), ScanVariant(2), np.eye(4))
    for _ in range(2):
        [made] = job.register_trial(Job(DataSource(Path()), ("loading",), Config()), trial, ({}, {}), ({}, {}))
        assert made.ms is not None
        assert made.ms < 300.0
    assert len(calls) == 3


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[ScanVariant]:
    """Registrations without scans: which of them were prepared."""
    prepared: list[ScanVariant] = []

    def shared_scan(job: Job, variant: ScanVariant) -> None:
        prepared.append(variant)

    monkeypatch.setattr("segslam.bench.experiments.benchmark.shared_scan", shared_scan)
    return prepared


def test_each_scan_is_prepared_once_though_many_pairs_have_it(counted: list[ScanVariant], tmp_path: Path) -> None:
    trials = pair_trials(cut_pairs(drive(120), name="cut", min_m=0.0, max_m=3.0), drive(120))
    job = Job(DataSource(tmp_path), ("gicp", "vgicp"), Config())
    rows = [one for some in run(job, trials) for one in some]
    assert len(rows) == 2 * len(trials) > 200
    assert len(counted) == len(set(counted)) == 120
    assert {one.reason for one in rows} == {"bad_scan"}


def test_a_benchmark_continues_where_it_stopped_and_not_in_the_folder_of_another(
    counted: list[ScanVariant], tmp_path: Path
) -> None:
    trials = pair_trials(cut_pairs(drive(80), name="cut", min_m=0.0, max_m=3.0), drive(80))
    job = Job(DataSource(tmp_path), ("gicp", "vgicp"), Config())
    folder = tmp_path / "bench"
    stopped = run(job, trials, folder=folder)
    for _ in range(5):
        next(stopped)
    stopped.close()
    file = folder / "details.csv"
    file.write_text(file.read_text()[:-15])  # killed within the last line: that pair is done again
    before = len(counted)
    rows = [one for some in run(job, trials, folder=folder) for one in some]
    again = [one for some in run(job, trials) for one in some]
    assert [(one.trial_key, one.method) for one in rows] == [(one.trial_key, one.method) for one in again]
    assert read_rows(file) == rows
    assert len(counted) > before
    with pytest.raises(SegslamError, match="other methods"):
        next(run(Job(job.source, ("gicp",), job.config), trials, folder=folder))
    with pytest.raises(SegslamError, match="other pairs"):
        next(run(job, trials[1:], folder=folder))


def test_a_finished_benchmark_registers_nothing_again(counted: list[ScanVariant], tmp_path: Path) -> None:
    trials = [Trial("one", ScanVariant(1), ScanVariant(70), np.eye(4))]
    job = Job(DataSource(tmp_path), ("gicp",), Config())
    repeat: Callable[[], list[list[Row]]] = lambda: list(run(job, trials, folder=tmp_path / "bench"))  # noqa: E731
    first = repeat()
    counted.clear()
    assert repeat() == first
    assert counted == []
