"""`segslam bench` as typed: the contract's figures, reports, and bad usage in one line."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import NUM_SCANS, write_kitti_sequence

KEYS = {
    "num_pairs",
    "success_percent",
    "translation_m",
    "rotation_deg",
    "num_false_accepted",
    "num_rejected",
    "median_ms",
    "p95_ms",
    "mean_edges",
}
"""Scripts outside the project read them."""
QUICK = ("--method", "segregator", "--method", "segator", "--labels", "true_labels", "--quiet")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive that holds only the scans that its list names: all others have no file."""
    folder = tmp_path_factory.mktemp("kitti")
    velodyne = write_kitti_sequence(folder)
    named = {0, 10, 3, 55, 5, 57, 9, 60}
    for number in set(range(NUM_SCANS)) - named:
        (velodyne / f"{number:06d}.bin").unlink()
    (folder / "pairs.txt").write_text("3 55\n5 57\n9 60\n")
    return folder


def bench(kind: str, data: Path, *options: object) -> int:
    return run("bench", kind, data, "--pairs", data / "pairs.txt", *QUICK, *options)


def test_pairs_prints_the_figures_of_each_method_and_a_row_a_registration(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench("pairs", data, "--json", "--details", tmp_path / "rows.csv") == 0
    printed = capsys.readouterr()
    figures = json.loads(printed.out)
    assert printed.err == ""
    assert list(figures) == ["segregator", "segator"]
    for own in figures.values():
        assert set(own) >= KEYS
        assert own["num_pairs"] == 3
        assert own["success_percent"] == 100.0
        assert own["translation_m"] < 0.3
        assert 0 < own["median_ms"] <= own["p95_ms"]
        assert own["mean_edges"] > 0
    with (tmp_path / "rows.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["source"], row["target"], row["method"]) for row in rows[:2]] == [
        ("3", "55", "segregator"),
        ("3", "55", "segator"),
    ]
    assert len(rows) == 6


def test_the_table_fits_the_terminal(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    quick = [option for option in QUICK if option != "--quiet"]
    assert run("bench", "pairs", data, "--pairs", data / "pairs.txt", *quick) == 0
    shown = capsys.readouterr().out.splitlines()  # where the tables of `eval` and `compare` are, too
    assert max(map(len, shown)) <= 80
    assert "p95 MB" in shown[-3]


def test_a_list_can_be_cut_from_the_true_poses_and_sampled(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cut = ("--min-m", 0, "--max-m", 8, "--min-gap", 45)
    assert run("bench", "pairs", data, *cut, *QUICK, "--json") == 0
    whole = json.loads(capsys.readouterr().out)["segregator"]["num_pairs"]
    assert whole > 2
    assert run("bench", "pairs", data, *cut, "--sample", 2, *QUICK, "--json") == 0
    assert json.loads(capsys.readouterr().out)["segregator"]["num_pairs"] == 2


@pytest.mark.long
def test_a_benchmark_is_replaced_only_if_wanted(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, options = tmp_path / "out", ("--method", "segator", "--labels", "true_labels", "--quiet")
    call = ("bench", "pairs", data, "--pairs", data / "pairs.txt", *options, "--out", out)
    assert run(*call) == 0
    assert run(*(one for one in call if one != "--quiet")) == 0
    assert "bench: 3/3" not in capsys.readouterr().err  # all were finished before
    rows = (out / "details.csv").read_text().replace(",segator,True,", ",segator,False,")
    for more, kept in (((), True), (("--overwrite",), False)):
        (out / "details.csv").write_text(rows)
        (out / "failure_01.png").touch()
        assert run(*call, *more) == 0
        assert (",segator,False," in (out / "details.csv").read_text()) is kept
        assert (out / "failure_01.png").exists() is kept
    (out / "pairs.txt").write_text("3 55\n")
    assert run("bench", "pairs", data, "--pairs", out / "pairs.txt", *options, "--out", out, "--overwrite") == 2
    assert "contains the input" in capsys.readouterr().err
    assert (out / "details.csv").exists()


def test_lists_of_one_name_in_two_folders_are_two_rows(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "pairs.txt").write_text("0 57\n3 55\n")
    options = ("--pairs", tmp_path / "pairs.txt", "--method", "segator", "--labels", "true_labels", "--json")
    again = ("--pairs", data / "pairs.txt")  # a list that is named twice is one list
    assert run("bench", "pairs", data, "--pairs", data / "pairs.txt", *options, *again) == 0
    figures = json.loads(capsys.readouterr().out)["segator"]
    assert [(row["list"], row["num_pairs"]) for row in figures["by"]] == [
        (str(data / "pairs.txt"), 3),
        (str(tmp_path / "pairs.txt"), 2),
    ]


def test_the_report_has_figures_paper_and_conditions_and_draws_failures(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GICP from the identity fails where 12 m and 40 degrees lie between the scans, which gives something to draw."""
    out = tmp_path / "out"
    (tmp_path / "pairs.txt").write_text("0 57\n3 60\n3 9\n")
    options = ("--pairs", tmp_path / "pairs.txt", "--sample", 2, "--method", "gicp", *QUICK, "--out", out)
    assert run("bench", "pairs", data, *options, "--draw", 2) == 0
    assert capsys.readouterr().out == ""
    report = json.loads((out / "report.json").read_text())
    assert report["lists"] == [{"name": "pairs", "pairs": 2, "of": 3}]
    assert report["options"]["seed"] == 0
    assert {"machine", "commit", "packages", "settings", "notes"} <= set(report)
    page, text = (out / "report.html").read_text(), (out / "report.md").read_text()
    assert "http" not in page.split("<body>")[0]
    assert page.count("data:image/svg+xml") == 2
    failures = list(out.glob("failure_*.png"))
    assert len(failures) == page.count("data:image/png") == 2
    assert "SAMPLED: pairs 2 of 3" in text
    assert "| segregator | 2 | 100.0 |" in text
    assert str(data) not in page + text + json.dumps(report)
    before = (out / "details.csv").read_bytes()
    assert run("bench", "pairs", data, *options) == 0  # nothing is left to do
    assert (out / "details.csv").read_bytes() == before


def test_yaw_turns_the_source_of_the_papers_pair(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("bench", "yaw", data, "--step-deg", 90, *QUICK, "--json", "--out", tmp_path) == 0
    by = json.loads(capsys.readouterr().out)["segregator"]["by"]
    assert [one["yaw_deg"] for one in by] == [0, 90, 180, 270]
    errors = [one["accepted_m"] for one in by]
    assert np.ptp(errors) < 0.1  # a turn changes the bins of the clusters and no more
    assert "Success (%) by yaw" in (tmp_path / "report.md").read_text()


@pytest.mark.long
def test_deterioration_takes_labels_from_one_scan_or_both(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--lost", 30, "--lost", 100, "--draws", 2, "--json")
    for clouds in ("one", "both"):
        assert bench("deterioration", data, *options, "--clouds", clouds, "--out", tmp_path / clouds) == 0
        by = json.loads(capsys.readouterr().out)["segregator"]["by"]
        assert [(one["lost_percent"], one["num_pairs"], one["num_rejected"]) for one in by] == [(30, 6, 0), (100, 6, 6)]
    assert "| 100 | 0.0 | 0.0 |" in (tmp_path / "both" / "report.md").read_text()


def test_timing_prints_the_time_of_each_stage(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench("timing", data, "--json") == 0
    own = json.loads(capsys.readouterr().out)["segregator"]
    assert own["stage_ms"]["prepare_ms"] > 0
    assert own["stage_ms"]["match_ms"] > 0
    assert own["stage_ms"]["refine_ms"] is None


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--method", "magic"], "magic"),
        (["--min-m", "3"], "not both"),
        (["--draw", "2"], "--out"),
        (["--sequence", "09"], "09"),
        (["--set", "segregator.magic=1"], "segregator.magic"),
    ],
)
def test_bad_usage_is_named_in_one_line(
    data: Path, capsys: pytest.CaptureFixture[str], options: list[str], expected: str
) -> None:
    assert bench("pairs", data, *options) == 2
    message = capsys.readouterr().err.strip()
    assert expected in message
    assert len(message.splitlines()) == 1


def test_missing_scans_and_lists_are_named(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "other.txt").write_text("3 55\n4 56\n")
    assert run("bench", "pairs", data, "--pairs", tmp_path / "other.txt", *QUICK) == 2
    assert "scan 4 has no file, nor have 1 other" in capsys.readouterr().err
    rows = [{"source": 3, "target": target, "T_target_source": np.eye(4).tolist()} for target in (55, 56)]
    (tmp_path / "other.json").write_text(json.dumps(rows))
    assert run("bench", "pairs", data, "--pairs", tmp_path / "other.json", *QUICK) == 2
    assert "scan 56 has no file" in capsys.readouterr().err
    for name, text in (("huge.txt", "3 99999999999999999999"), ("huge.json", json.dumps(rows).replace("55", "1e400"))):
        (tmp_path / name).write_text(text)
        assert run("bench", "pairs", data, "--pairs", tmp_path / name, *QUICK) == 2
        assert name in capsys.readouterr().err
    assert run("bench", "pairs", data, *QUICK) == 2
    assert "--pairs" in capsys.readouterr().err
    assert run("bench", "pairs", data, "--min-m", 3000, "--max-m", 5000, *QUICK) == 2
    assert "--min-m 3000 --max-m 5000: no two scans" in capsys.readouterr().err


def test_rows_of_other_data_are_not_taken_for_those_asked(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert bench("pairs", data, "--sample", 1, "--out", out) == 0
    other = tmp_path / "other"
    other.symlink_to(data)
    assert bench("pairs", other, "--sample", 1, "--out", out) == 0, "the same data under another name"
    other.unlink()
    shutil.copytree(data, other)
    capsys.readouterr()
    assert bench("pairs", other, "--sample", 1, "--out", out) == 2
    assert "contains a benchmark with other data" in capsys.readouterr().err
    (out / "asked.json").write_text("[]")
    assert bench("pairs", data, "--sample", 1, "--out", out) == 2
    assert "asked.json: is not of a benchmark" in capsys.readouterr().err


def test_a_broken_scan_costs_its_pairs_alone(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = data / "sequences" / "00" / "velodyne" / "000055.bin"
    whole = file.read_bytes()
    file.write_bytes(whole[:1001])
    try:
        assert bench("pairs", data, "--json", "--details", tmp_path / "rows.csv") == 0
    finally:
        file.write_bytes(whole)
    own = json.loads(capsys.readouterr().out)["segregator"]
    assert (own["num_pairs"], own["num_rejected"]) == (3, 1)
    assert "bad_scan" in (tmp_path / "rows.csv").read_text()
