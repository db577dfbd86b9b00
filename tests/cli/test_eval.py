"""`segslam eval` as typed: figures out, metrics.json brought up to date, bad input in one line."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.finished_run import METRICS, T_CAMERA_LIDAR, make_run
from helpers.made_logs import largest_file

from segslam import cli
from segslam.core.evaluation import trajectory_metrics
from segslam.core.pose_files import read_poses, write_kitti, write_tum
from segslam.core.trajectory import camera_from_lidar
from segslam.output.accuracy import scores


def _eval(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        cli.main(["eval", *(str(argument) for argument in arguments)])
    return int(ended.value.code or 0)


def _write_pair(folder: Path, *, num_estimated: int = 60) -> tuple[Path, Path]:
    """An estimate in KITTI's format and the truth of 60 poses, and their TUM twins."""
    rng = np.random.default_rng(0)
    truth = np.tile(np.eye(4), (60, 1, 1))
    truth[:, :3, 3] = np.cumsum(rng.normal(size=(60, 3)), axis=0)
    estimate = truth.copy()
    estimate[:, :3, 3] += 0.1 * rng.normal(size=(60, 3))
    stamps = np.arange(60) * 10**8
    write_kitti(folder / "truth.txt", truth)
    write_kitti(folder / "estimate.txt", estimate[:num_estimated])
    write_tum(folder / "truth_tum.txt", stamps[::-1], truth[::-1])
    write_tum(folder / "estimate_tum.txt", stamps[:num_estimated] + 3_000_000, estimate[:num_estimated])
    return folder / "estimate.txt", folder / "truth.txt"


def test_two_files_are_scored_as_the_library_scores_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    estimate, truth = _write_pair(tmp_path)
    assert _eval("--estimate", estimate, "--reference", truth, "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    expected = scores(read_poses(estimate).T_a_b, read_poses(truth).T_a_b, up=(0.0, -1.0, 0.0))
    assert figures == expected | {"num_poses": 60, "up": "-y"}


def test_tum_files_are_matched_by_stamp_to_the_same_errors(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    estimate, truth = _write_pair(tmp_path)
    _eval("--estimate", estimate, "--reference", truth, "--up", "z", "--json")
    by_row = json.loads(capsys.readouterr().out)
    assert by_row["up"] == "z"
    tum = ("--estimate", tmp_path / "estimate_tum.txt", "--reference", tmp_path / "truth_tum.txt", "--json")
    assert _eval(*tum) == 0
    assert json.loads(capsys.readouterr().out) == pytest.approx(by_row, abs=1e-9)
    assert _eval(*tum, "--max-difference", "0.002") == 2
    assert "only 0 of its 60 poses match one of the 60" in capsys.readouterr().err


def test_rows_of_another_number_cannot_be_matched_but_stamps_can(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate, truth = _write_pair(tmp_path, num_estimated=40)
    assert _eval("--estimate", estimate, "--reference", truth) == 2
    assert "estimate.txt: 40 poses, but" in capsys.readouterr().err
    tum = ("--estimate", tmp_path / "estimate_tum.txt", "--reference", tmp_path / "truth_tum.txt")
    assert _eval(*tum) == 0
    printed = capsys.readouterr()
    assert "scored 40 poses; estimate 40, reference 60" in printed.err
    assert "absolute trajectory error after alignment" in printed.out


def test_a_pose_beyond_all_numbers_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    estimate, truth = _write_pair(tmp_path)
    estimate.write_text("1 0 0 1e200 0 1 0 0 0 0 1 0\n" * 60)
    assert _eval("--estimate", estimate, "--reference", truth, "--json") == 2
    assert "estimate.txt:1: 1 0 0 1e200 0 1 0 0 0 0 1 0: every number must be finite" in capsys.readouterr().err


def test_two_poses_are_too_few_to_be_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_kitti(tmp_path / "two.txt", np.tile(np.eye(4), (2, 1, 1)))
    assert _eval("--estimate", tmp_path / "two.txt", "--reference", tmp_path / "two.txt") == 2
    assert "only 2 of its 2 poses match one of the 2" in capsys.readouterr().err


def test_the_upward_axis_of_kitti_files_is_found_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make_run(tmp_path / "run")
    off = made.truth.T_world_lidar.copy()
    off[:, 2, 3] += 0.5 * np.sin(np.arange(len(off)))  # a height error
    height_m = trajectory_metrics(off, made.truth.T_world_lidar)["height_m"]
    for up, convert in (("z", lambda poses: poses), ("-y", lambda poses: camera_from_lidar(poses, T_CAMERA_LIDAR))):
        for name, poses in (("truth", made.truth.T_world_lidar), ("off", off)):
            write_kitti(tmp_path / f"{name}.txt", convert(poses))
        assert _eval("--estimate", tmp_path / "off.txt", "--reference", tmp_path / "truth.txt", "--json") == 0
        printed = capsys.readouterr()
        assert f"truth.txt: upward axis {up} (" in printed.err
        figures = json.loads(printed.out)
        assert figures["up"] == up
        assert figures["height_m"] == pytest.approx(height_m, abs=1e-3)


def test_kitti_files_are_drawn_from_above(tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    write_kitti(tmp_path / "lidar.txt", made.truth.T_world_lidar)
    write_kitti(tmp_path / "camera.txt", camera_from_lidar(made.truth.T_world_lidar, T_CAMERA_LIDAR))
    for name, labels in (("lidar", ("x (m)", "y (m)")), ("camera", ("x (m)", "z (m)"))):
        files = ("--estimate", tmp_path / f"{name}.txt", "--reference", tmp_path / f"{name}.txt")
        assert _eval(*files, "--plot", tmp_path / f"{name}.svg", "--quiet") == 0
        assert all(label in (tmp_path / f"{name}.svg").read_text() for label in labels)


def test_figures_of_an_earlier_reference_do_not_stay(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make_run(tmp_path / "run")
    assert _eval(made.folder, "--json") == 0
    assert "num_loops_false" in json.loads(capsys.readouterr().out)
    few = made.truth.stamp_ns[:4], made.truth.T_world_lidar[:4]  # no loop lies within
    write_tum(tmp_path / "few.txt", *few)
    assert _eval(made.folder, "--reference", tmp_path / "few.txt", "--json") == 0
    printed = capsys.readouterr()
    assert "scored the 4 of 120 scans that have a reference pose" in printed.err
    assert not {"num_loops_false", "loop_precision"} & json.loads(printed.out).keys()
    write_tum(tmp_path / "few.txt", few[0][:2], few[1][:2])
    assert _eval(made.folder, "--reference", tmp_path / "few.txt") == 2
    assert "only 2 of 120 scans have a pose" in capsys.readouterr().err


def test_run_takes_the_new_figures_into_its_metrics(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make_run(tmp_path / "run")
    assert _eval(made.folder, "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    kept = json.loads((made.folder / "metrics.json").read_text())
    assert {key: figures[key] for key in kept} == kept
    assert set(figures) - set(kept) == {"ate_mean_m", "ate_median_m", "ate_max_m"}
    assert {key: figures[key] for key in METRICS} == METRICS
    assert figures["num_loops_false"] == 1
    assert figures["loop_precision"] == 0.75
    assert figures["ate_m"] < 0.2 * figures["odometry_ate_m"]  # made so: the keyframes are true, the odometry drifts


def test_a_run_that_cannot_be_written_is_scored_all_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = make_run(tmp_path / "run")
    with largest_file(10):
        assert _eval(made.folder, "--json") == 2
    shown = capsys.readouterr()
    assert json.loads(shown.out)["loop_precision"] == 0.75
    assert "cannot write the results (File too large); free space there" in shown.err


def test_run_is_scored_against_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make_run(tmp_path / "run", with_truth=False)
    assert _eval(made.folder) == 2
    assert "the data has no ground-truth poses; give a file with --reference" in capsys.readouterr().err
    write_tum(tmp_path / "truth.txt", made.truth.stamp_ns, made.truth.T_world_lidar)
    assert _eval(made.folder, "--reference", tmp_path / "truth.txt", "--quiet") == 0
    assert capsys.readouterr().out == ""
    assert json.loads((made.folder / "metrics.json").read_text())["num_loops_false"] == 1


def test_options_of_files_apply_to_the_reference_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = make_run(tmp_path / "run")
    write_tum(tmp_path / "late.txt", made.truth.stamp_ns + 15_000_000, made.truth.T_world_lidar)
    late = (made.folder, "--reference", tmp_path / "late.txt")
    assert _eval(*late) == 2
    assert "none of its 120 poses belongs to a scan" in capsys.readouterr().err
    assert _eval(*late, "--max-difference", "0.02", "--json") == 0
    assert json.loads(capsys.readouterr().out)["num_loops_false"] == 1
    for more, complaint in (
        ((*late, "--format", "kitti"), "found 8 numbers; KITTI"),
        ((made.folder, "--format", "kitti"), "only for poses of a file; give one with --reference"),
        ((made.folder, "--max-difference", "0.02"), "only for poses of a file; give one with --reference"),
        ((made.folder, "--up=-y"), "the poses of a run have z up; omit the option"),
    ):
        assert _eval(*more) == 2
        printed = capsys.readouterr()
        assert complaint in printed.err
        assert printed.out == ""


@pytest.mark.parametrize("value", ["inf", "nan", "-1", "1e300"])
def test_time_differences_beyond_all_clocks_are_wrong_usage(tmp_path: Path, value: str) -> None:
    _write_pair(tmp_path)
    tum = ("--estimate", tmp_path / "estimate_tum.txt", "--reference", tmp_path / "truth_tum.txt")
    assert _eval(*tum, "--max-difference", value) == 2


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ([], "give either a run folder, or two files"),
        (["--estimate", "estimate.txt"], "give either a run folder, or two files"),
        (["nowhere"], "nowhere: no such file or folder"),
        (["--estimate", "nowhere.txt", "--reference", "truth.txt"], "nowhere.txt: no such file; give a KITTI or TUM"),
        (["--estimate", "estimate.txt", "--reference", "truth_tum.txt"], "another format than"),
        (["--estimate", "estimate.txt", "--reference", "truth.txt", "--format", "tum"], "found 12 numbers; TUM"),
    ],
)
def test_bad_input_ends_with_status_2_and_one_line(
    tmp_path: Path,
    arguments: list[str],
    complaint: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _write_pair(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert _eval(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert complaint in printed.err
    assert printed.err.count("\n") == 1
