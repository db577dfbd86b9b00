"""Each benchmark runs to completion, on one or two pairs or on twenty scans, and its figures match its input."""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import write_kitti_sequence
from helpers.finished_run import make_run

from segslam.bench.experiments.pairs import PairList
from segslam.bench.simulation.tracks import example_drive
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.pose_files import write_kitti
from segslam.core.trajectory import camera_from_lidar
from segslam.output.finished import read_run
from segslam.slam.slam_result import SlamResult
from tools.benchmarks import (
    common,
    label_maps,
    labels,
    live,
    locate,
    motions,
    odometry,
    peers,
    real,
    real_pairs,
    recognition,
    scenes,
    sequences,
    submaps,
    trouble,
)
from tools.benchmarks import map as map_benchmark
from tools.benchmarks.back_end import __main__ as back_end
from tools.benchmarks.faults import __main__ as faults
from tools.benchmarks.registration import __main__ as registration
from tools.benchmarks.speed import __main__ as speed
from tools.benchmarks.speed import growth

NUM_SCANS = 20

Call = Callable[..., dict[str, Any]]


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Call:
    """Runs the program of a benchmark with `--out`, and gives the figures that it wrote."""

    def called(module: ModuleType, *words: object) -> dict[str, Any]:
        out = tmp_path / "figures.json"
        monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, words), "--out", str(out)])
        module.main()
        return json.loads(out.read_text())

    return called


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty scans in KITTI's layout with true poses and labels."""
    folder = tmp_path_factory.mktemp("kitti")
    write_kitti_sequence(folder, num_scans=NUM_SCANS)
    for file in (folder / "sequences" / "00" / "times.txt", folder / "poses" / "00.txt"):
        file.write_text("".join(file.read_text().splitlines(keepends=True)[:NUM_SCANS]))
    return folder


@pytest.fixture(scope="module")
def mapped(short_runs: None, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of those scans, the odometry given."""
    out = tmp_path_factory.mktemp("runs") / "run"
    poses = data / "poses" / "00.txt"
    words = ("--labels", "true_labels", "--odometry", poses, "--set", "adjustment.max_minutes=0", "--quiet")
    assert run("map", data, "--out", out, *words) == 0
    return out


@pytest.fixture
def one_pair(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the real pairs of KITTI 00 the first with labels of a network."""
    read = real_pairs.reference_pairs

    def first(data: Path) -> PairList:
        whole = read(data)
        return replace(whole, pairs=whole.pairs[np.isin(whole.pairs, real_pairs.PREDICTED).all(axis=1)][:1])

    monkeypatch.setattr(real_pairs, "reference_pairs", first)


def printed(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    return json.loads(capsys.readouterr().out)


def test_a_report_is_written_with_figures_that_are_no_numbers(tmp_path: Path) -> None:
    """A rejected pose has an infinite error, and a mean over nothing is not a number."""
    common.write_report(tmp_path / "figures.json", {"rows": [{"worst_m": np.inf, "mean_m": float("nan"), "pairs": 3}]})
    written = json.loads((tmp_path / "figures.json").read_text())
    assert written["rows"] == [{"worst_m": None, "mean_m": None, "pairs": 3}]


def test_labels_without_a_correct_registration_have_tables() -> None:
    none = {"success_percent": 0.0, "num_pairs": 2, "num_false_accepted": 0, "coarse_m": None, "coarse_deg": None}
    none |= {"refined_m": None, "refined_deg": None}
    results = {"class_iou": {"all": {"car": 0.5, "pole": 0.5}, "scan 0": {"car": 0.5}}, "kitti": {"all pairs": none}}
    results |= {"num_yaws": 1, "courtyard": {}, "speed": {"num_points": 1} | _no_times()}
    assert "0.0 % of 2" in labels.tables(results)


@pytest.mark.long
def test_back_end_keeps_true_closures_and_lowers_the_error(call: Call, tmp_path: Path) -> None:
    folder = tmp_path / "kitti" / "sequences" / "00"
    folder.mkdir(parents=True)
    (tmp_path / "kitti" / "poses").mkdir()
    (folder / "calib.txt").write_text(example_drive(1).calib)
    angles = 2.0 * np.pi * np.arange(150) / 100
    poses = np.stack([geometry.transform(geometry.yaw(a), [48 * np.sin(a), 48 - 48 * np.cos(a), 0.0]) for a in angles])
    T_camera_lidar = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    write_kitti(tmp_path / "kitti" / "poses" / "00.txt", camera_from_lidar(poses, T_camera_lidar))
    (row,) = call(back_end, tmp_path, "--sequence", "00", "--odometry", "drifting", "--share", "0.3")["rows"]
    assert row["without_outliers"]["true_rejected"] == 0
    assert row["without_outliers"]["ate_m"] < row["search"]["odometry_ate_m"]
    assert {outliers["kind"] for outliers in row["outliers"]} == {"random", "grouped", "nearby"}


def test_sequences_reports_errors_of_a_run_with_its_own_and_with_exact_closures(call: Call, tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    (row,) = call(sequences, made.folder)["rows"]
    assert row["loops"]["closures"] == 4
    assert row["loops"]["num_loops_false"] == 1
    assert row["exact"]["ate_m"] < row["odometry"]["ate_m"]


def test_sequences_shows_a_run_without_closures() -> None:
    errors = {"closures": 0, "ate_m": 1.0, "switched_off": 0}
    row = {"run": "a/run", "odometry": errors, "found": errors, "exact": errors, "exact_everywhere": errors}
    row |= {"loops": {"closures": 0}, "noise": {"chain_1": 1.0, "chain_10": None, "chain_100": None, "closures": None}}
    assert sequences.cells(row | {"ate_by_exact": 1.0})["closures, false, off"] == "0, 0, 0"


def test_real_shows_where_true_poses_contradict_the_scans(mapped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The scans of a run with true poses as odometry agree with them; then later true heights are wrong by 0.3 m."""
    made = read_run(mapped)
    assert made.reference is not None
    monkeypatch.setattr(
        SlamResult, "closures", lambda _: [SimpleNamespace(target_id=n, source_id=n + 8) for n in (0, 1)]
    )
    right = real.thickness_at_loops(made)
    assert right["thickness_at_loops_m"] < right["thickness_at_loops_true_m"] < 0.02
    T_wrong = made.reference.T_world_lidar.copy()
    T_wrong[5:, 2, 3] += 0.3
    wrong = real.thickness_at_loops(replace(made, reference=replace(made.reference, T_world_lidar=T_wrong)))
    assert wrong["thickness_at_loops_m"] == right["thickness_at_loops_m"]
    assert wrong["thickness_at_loops_true_m"] > 0.04


def test_motions_tells_a_wrong_truth_from_a_wrong_pose(
    call: Call, mapped: Path, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three motions: the run and the truth are right; the truth is wrong by 0.3 m; the run is."""
    reference = read_run(mapped).reference
    assert reference is not None
    T_wrong = geometry.transform(np.eye(3), np.array([0.3, 0.0, 0.0]))
    covariance = np.diag(geometry.tangent(rotation_rad=0.01, translation_m=0.03) ** 2)
    made = []
    for row, (of_run, of_truth) in enumerate([(np.eye(4), np.eye(4)), (np.eye(4), T_wrong), (T_wrong, np.eye(4))]):
        T_right = geometry.inverse(reference.T_world_lidar[row]) @ reference.T_world_lidar[row + 1]
        made.append(real.ComparedMotion((row, row + 1), T_right @ of_run, T_right @ of_truth, covariance))
    monkeypatch.setattr(motions, "compared_motions", lambda _: made)
    found = call(motions, data, mapped)
    assert (found["motions"], found["outside"]) == (3, 2)
    assert (found["measured_again_as_in_the_run"], found["as_the_true_one"], found["as_neither"]) == (1, 1, 0)


def test_peers_reads_the_poses_and_closures_of_the_other_program(call: Call, tmp_path: Path) -> None:
    made = make_run(tmp_path / "work" / "segslam_scans")
    (tmp_path / "scans").mkdir()
    first = int(made.truth.scan_index[0])
    np.save(tmp_path / "poses.npy", np.concatenate([np.tile(np.eye(4), (first, 1, 1)), _camera(made.truth)]))
    program = tmp_path / "other"
    program.write_text(
        f"#!/bin/sh\nmkdir latest && cp {tmp_path / 'poses.npy'} latest/a_poses.npy\necho Number of closures found 3\n"
    )
    program.chmod(0o755)
    found = call(peers, tmp_path / "scans", "--kiss-slam", program, "--work", tmp_path / "work")
    assert found["kiss-slam"]["num_loops_accepted"] == 3
    assert found["kiss-slam"]["ate_m"] == pytest.approx(0.0, abs=1e-9)
    assert found["segslam"]["num_loops_accepted"] == 4


def _camera(truth: Any) -> np.ndarray:
    from helpers.finished_run import T_CAMERA_LIDAR

    return camera_from_lidar(truth.T_world_lidar, T_CAMERA_LIDAR)


def test_locate_finds_scans_in_the_run_that_they_are_of(
    mapped: Path, data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["locate", str(mapped), str(data), "--labels", "true_labels", "--every", "10"]
    monkeypatch.setattr(sys, "argv", words)
    locate.main()
    figures = printed(capsys)
    assert figures["outcomes"] == {"found": 2}
    assert figures["success"] == 1.0


def test_map_counts_what_moves_and_what_stands(call: Call, mapped: Path, data: Path, monkeypatch: Any) -> None:
    labelled = shutil.copytree(data, mapped.parent / "labelled")
    (labelled / "sequences" / "00" / "true_labels").rename(labelled / "sequences" / "00" / "labels")
    figures = call(map_benchmark, mapped, labelled, "--every", "5")
    assert figures["num_keyframes"] == NUM_SCANS
    assert figures["moving"] == 0  # the drive has no moving cars
    assert figures["standing_lost_percent"] < 5.0


@pytest.mark.long
def test_odometry_compares_voxel_sizes_and_another_library(call: Call, data: Path) -> None:
    rows = call(odometry, data, "--sequence", "00", "--voxels", "1,2")["rows"]
    assert [row["odometry"] for row in rows] == ["KISS-ICP, 1 m", "KISS-ICP, 2 m", "small_gicp VGICP"]
    assert all(row["ate_m"] < 2.0 for row in rows)
    assert all(row["median_ms"] > 0 for row in rows)


@pytest.mark.slow
def test_trouble_is_applied_to_the_drive_that_is_mapped(call: Call, data: Path) -> None:
    words = ["--sequence", "00", "--frames", "0:20", "--at", "8", "--only", "given odometry, jump of 3 m"]
    (row,) = call(trouble, data, *words)["rows"].values()
    assert (row["repaired"], row["broken"]) == (1, 0)
    assert row["ate_m"] < 0.1


def test_scenes_judges_true_and_false_pairs(call: Call) -> None:
    words = ["--pairs", 2, "--scenes", "corridor", "--sensors", "16", "--noise", "0.03"]
    (row,) = call(scenes, *words)["rows"]
    assert row["overlapping"] <= 2
    assert sum(row["rejected"].values()) + row["false_accepted"] <= 2


@pytest.mark.long
@pytest.mark.data
def test_submaps_of_a_real_drive_are_registered(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["submaps", str(data_dir), "--pairs", "1", "--negatives", "1"])
    submaps.main()
    true, false = capsys.readouterr().out.splitlines()
    assert true == "true pairs: 1: {'right': 1}"
    assert "right" not in false
    assert "wrong" not in false


@pytest.mark.long
@pytest.mark.data
def test_recognition_searches_the_older_places(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["recognition", str(data_dir), "--queries", "24:26", "--left-out", "20"])
    recognition.main()
    figures = printed(capsys)
    assert figures["queries"] == sum(figures["outcomes"].values()) == 2


@pytest.mark.long
@pytest.mark.data
@pytest.mark.usefixtures("one_pair")
def test_registration_aligns_real_pairs(call: Call, data_dir: Path, tmp_path: Path) -> None:
    words = ["--parts", "real", "--yaws", "1", "--cache", tmp_path]
    rows = call(registration, data_dir, *words)["tables"]["Real pairs, the source turned"]
    assert [row["labels"] for row in rows] == ["geometric", "predicted_labels"]
    assert all(row["coarse_percent"] == row["refined_percent"] == 100.0 for row in rows), rows


def test_registration_finds_half_of_6000_correspondences_and_none_where_none_is_right() -> None:
    half, nothing = registration.many_correspondences(Config(), rng=np.random.default_rng(0))
    assert half["inliers"] >= 35
    assert nothing["inliers"] < 10


@pytest.mark.slow
@pytest.mark.data
def test_every_part_of_registration_makes_its_tables(call: Call, data_dir: Path, tmp_path: Path) -> None:
    words = ["--parts", "simulated,negatives,speed,ablation", "--sequences", "06", "--sample", 1, "--negatives", 2]
    tables = call(registration, data_dir, *words, "--every", 99, "--cache", tmp_path)["tables"]
    assert len(tables) == 10
    assert all(tables.values())


@pytest.mark.long
@pytest.mark.data
@pytest.mark.usefixtures("one_pair")
def test_labels_by_shape_agree_with_the_truth_and_align_real_pairs(
    call: Call, data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(labels, "speed", lambda points: {"num_points": len(points)} | _no_times())
    words = ["--yaws", 1, "--pairs", 1, "--methods", "segregator-c2f", "--pictures", tmp_path / "pictures"]
    figures = call(labels, data_dir, *words)
    assert figures["class_iou"]["all"]["ground"] > 0.9
    assert {name: found["success_percent"] for name, found in figures["kitti"].items()} == dict.fromkeys(
        ("shape, all pairs", "shape, pairs with predictions", "a network's, the same pairs"), 100.0
    )
    assert [found["segregator-c2f"]["num_pairs"] for found in figures["courtyard"].values()] == [1, 1]
    assert len(list((tmp_path / "pictures").iterdir())) == 2


def _no_times() -> dict[str, float]:
    return {"thread_ms_median": 0.0, "thread_ms_p95": 0.0}


def test_speed_measures_a_drive_and_how_costs_grow(call: Call, data: Path) -> None:
    figures = call(speed, data, "--sequence", "00", "--frames", "0:6", "--labels", "true_labels", "--only", "latency")
    assert 0.0 < figures["latency"]["odometry_ms"]["median"] <= figures["latency"]["process_ms"]["max"]
    assert growth.optimisation(600, 20, false_share=0.0)["num_outliers"] == 0
    assert growth.exponent((1, 2, 4, 8), [1.0, 4.0, 16.0, 64.0]) == pytest.approx(2.0)


@pytest.mark.slow
def test_speed_closes_the_loops_of_a_long_drive_with_true_poses() -> None:
    found = growth.drive(560)
    assert found["num_closures"] >= 10
    assert found["worst_m"] < 4.0  # 5.8 m by the odometry alone


@pytest.mark.slow
def test_speed_runs_the_command_beside_kiss_icp(call: Call, data: Path) -> None:
    words = ["--sequence", "00", "--frames", "0:20", "--labels", "true_labels", "--rounds", 1]
    figures = call(speed, data, *words, "--only", "throughput", "start")
    assert set(figures["throughput"]) >= {"segslam", "kiss-icp", "kiss-icp-1"}
    assert figures["start"]["help_s"] > figures["start"]["bare_python_s"]


@pytest.mark.slow
def test_live_run_of_a_folder_that_fills_equals_the_offline_run(data: Path, tmp_path: Path, call: Call) -> None:
    scans = data / "sequences" / "00" / "velodyne"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["live", str(scans), "--every", "0.5", "--offline", "--out", str(tmp_path / "live")])
        live.main()
    figures = json.loads((tmp_path / "live" / "bench.json").read_text())
    assert figures["num_sent"] == NUM_SCANS
    assert figures["against_offline"]["largest_apart_m"] < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["live", "map", "disk"])
def test_after_a_drive_of_faults_every_scan_is_accounted_for(data: Path, tmp_path: Path, kind: str) -> None:
    scans = data / "sequences" / "00" / "velodyne"
    words = ["faults", str(scans), "--seconds", "1", "--only", kind, "--out", str(tmp_path / "faults")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", words)
        with pytest.raises(SystemExit) as ended:
            faults.main()
    figures = json.loads((tmp_path / "faults" / "bench.json").read_text())
    assert figures["problems"] == []
    assert figures["num_unaccounted"] == ended.value.code == 0
    assert figures["num_runs"] == 1
    assert figures["num_faults"] > 0


@pytest.mark.slow
def test_label_maps_compares_two_maps_of_one_drive(call: Call, tmp_path: Path) -> None:
    found = call(label_maps, tmp_path / "work", "--sensor", "vlp16", "--frames", NUM_SCANS)
    assert found["vlp16"]["true"]["num_scans"] == found["vlp16"]["shape"]["num_scans"] == NUM_SCANS
