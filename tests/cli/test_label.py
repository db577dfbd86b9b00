"""`segslam label`: files that read back as the labels, pictures in the classes' colours, scores that can fail."""

import json
import shutil
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import write_kitti_sequence
from helpers.made_networks import class_network

from segslam.bench.labelling import GROUPS, STILL, Tally, class_scores, confusion, largest_confusions, scores
from segslam.core.types import Label
from segslam.labels.encodings import RAW_OF_LABEL, Encoding, of_classes, to_labels
from segslam.labels.label_files import read_ids, read_labels
from segslam.scans import open_dataset

NUM_SCANS = 3
SENSOR = {"field_of_view_deg": [-22.8, 22.5], "height": 64, "width": 1024}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scans whose intensities are the learning ids; the second has rows without return."""
    root = tmp_path_factory.mktemp("drive")
    for file in sorted(write_kitti_sequence(root, num_scans=NUM_SCANS).glob("*.bin")):
        returns = np.fromfile(file, "<f4").reshape(-1, 4)
        returns[:, 3] = to_labels(read_ids(file.parents[1] / "true_labels" / f"{file.stem}.label"), "raw")
        if file.stem == "000001":
            returns[100:200, :3] = 0
            returns[300, 0] = np.nan
        returns.tofile(file)
    return root


def _num_returns(drive: Path, name: str) -> int:
    return (drive / "sequences" / "00" / "velodyne" / f"{name}.bin").stat().st_size // 16


def _labelled(drive: Path, out: Path, capsys: pytest.CaptureFixture[str], *options: object) -> dict:
    assert run("label", drive, "--out", out, *options, "--json", "--quiet") == 0
    return json.loads(capsys.readouterr().out)


def _network(folder: Path, *, shift: int = 0) -> str:
    """Gives back the classes that are the intensities; or others, `shift` further on."""
    classes = [0, *((np.arange(19) + shift) % 19 + 1).tolist()]
    return f"network:{class_network(folder, classes=classes, **SENSOR)}"


@pytest.mark.parametrize("encoding", ["raw", "learning"])
def test_files_read_back_as_the_labels_a_row_for_each_of_the_scan(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], encoding: Encoding
) -> None:
    options = ("--labels", _network(tmp_path), "--write-as", encoding)
    figures = _labelled(drive, tmp_path / "out", capsys, *options)
    assert figures["num_scans"] == NUM_SCANS
    assert sum(figures["shares"].values()) == pytest.approx(1.0)
    for name in ("000000", "000001"):
        labels = read_labels(tmp_path / "out" / f"{name}.label", _num_returns(drive, name), encoding)
        truth = read_labels(drive / "sequences/00/true_labels" / f"{name}.label", len(labels), "raw")
        lost = np.zeros(len(labels), bool)
        if name == "000001":
            lost[[*range(100, 200), 300]] = True
        assert (labels[lost] == Label.UNLABELLED).all()
        assert (labels == truth)[~lost].mean() > 0.97  # the others are hidden behind the point of their pixel
    again = open_dataset(drive, labels=str(tmp_path / "out"), encoding=encoding)
    assert (again[1].labels != Label.UNLABELLED).mean() > 0.99


@pytest.mark.long
def test_scores_drop_for_a_network_whose_classes_are_shifted_by_one(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "shifted").mkdir()
    right = _labelled(drive, tmp_path / "a", capsys, "--labels", _network(tmp_path), "--truth", "true_labels")
    shifted = _network(tmp_path / "shifted", shift=1)
    wrong = _labelled(drive, tmp_path / "b", capsys, "--labels", shifted, "--truth", "true_labels")
    assert right["accuracy"] > 0.97
    assert right["mean_iou"] > 0.8
    assert wrong["accuracy"] < 0.05
    assert wrong["mean_iou"] < 0.05
    assert wrong["confusions"][0]["share"] > 0.1


def test_the_confusion_is_written_with_the_names_of_the_classes(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = _labelled(drive, tmp_path / "out", capsys, "--labels", "true_labels", "--truth", "true_labels")
    assert figures["accuracy"] == 1.0
    assert set(figures["iou"].values()) == {1.0}
    assert figures["confusions"] == []
    rows = [line.split(",") for line in (tmp_path / "out" / "confusion.csv").read_text().splitlines()]
    assert rows[0][1:] == [label.name.lower() for label in list(Label)[:20]]
    assert [row[0] for row in rows[1:]] == rows[0][2:]
    counts = np.array([row[1:] for row in rows[1:]], int)
    assert np.trace(counts[:, 1:]) == counts.sum() > 100_000


@pytest.mark.long
def test_pictures_show_each_class_in_its_colour(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--labels", "true_labels", "--truth", "true_labels", "--pictures", 2)
    _labelled(drive, tmp_path / "out", capsys, *options)
    assert sorted(file.name for file in (tmp_path / "out").glob("*.png")) == ["000000.png", "000002.png"]
    picture = np.round(255 * matplotlib.image.imread(tmp_path / "out" / "000000.png")[..., :3]).astype(int)
    labels = read_labels(drive / "sequences/00/true_labels/000000.label", _num_returns(drive, "000000"), "raw")
    for label in (Label.ROAD, Label.BUILDING, Label.CAR, Label.VEGETATION):
        assert (labels == label).sum() > 500
        [color] = of_classes(np.array([label], np.uint8))
        assert (np.abs(picture - color).max(axis=-1) <= 1).sum() > 200, label


def test_the_table_has_a_line_for_each_class(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ("--labels", "true_labels", "--truth", "true_labels", "--pictures", 0)
    assert run("label", drive, "--out", tmp_path / "out", *options) == 0
    output = capsys.readouterr()
    assert "label: 3/3" in output.err
    assert "building" in output.out
    assert "mean IoU 1.000" in output.out
    assert not list((tmp_path / "out").glob("*.png"))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--labels", "none", "--write-as", "learning-0"), "learning-0 has no id for unlabelled"),
        (("--labels", "geometric", "--truth", "nowhere"), "--truth nowhere: no folder"),
        (("--labels", "network:none.onnx"), "none.onnx: no such file"),
        (("--labels", "geometric", "--frames", "7:9"), "no such scan"),
        (("--labels", "geometric", "--truth-encoding", "raw"), "only true labels have one; give them with --truth"),
    ],
)
def test_bad_usage_is_reported(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], expected: str
) -> None:
    assert run("label", drive, "--out", tmp_path / "out", *options) == 2
    assert expected in capsys.readouterr().err


def test_a_stopped_command_reports_the_labels_written_so_far(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    add_scan = Tally.add

    def add(tally: Tally, row: int) -> None:
        if row == 1:
            raise KeyboardInterrupt
        add_scan(tally, row)

    monkeypatch.setattr(Tally, "add", add)
    out = tmp_path / "out"
    assert run("label", drive, "--labels", "geometric", "--out", out, "-q") == 130
    assert [file.name for file in sorted(out.glob("*.label"))] == ["000000.label"]
    assert f"stopped: {out} has the labels of the scans so far; for all scans: " in capsys.readouterr().err


def test_existing_files_are_not_overwritten(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "000000.label").write_bytes(b"mine")
    assert run("label", drive, "--out", tmp_path, "--labels", "true_labels") == 2
    assert (tmp_path / "000000.label").read_bytes() == b"mine"


def test_the_labels_that_are_read_are_not_overwritten(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "kitti"
    shutil.copytree(drive, root)
    (folder,) = {file.parent for file in root.rglob("*.label")}
    before = {file: file.read_bytes() for file in folder.iterdir()}
    assert run("label", root, "--out", folder, "--labels", "geometric", "--overwrite") == 2
    assert "inside the input" in capsys.readouterr().err
    assert {file: file.read_bytes() for file in folder.iterdir()} == before


def test_labels_that_are_named_as_their_source_are_written_again(
    drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "geometric").mkdir()
    (tmp_path / "geometric" / "000000.label").write_bytes(b"earlier")
    assert run("label", drive, "--out", "geometric", "--labels", "geometric", "--overwrite") == 0
    assert (tmp_path / "geometric" / "000000.label").read_bytes() != b"earlier"


@pytest.mark.long
def test_replaced_labels_leave_no_file_of_earlier_scans(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    out = tmp_path / "out"
    out.symlink_to("disk")
    options = ("--out", out, "--labels", "geometric", "--quiet")
    assert run("label", drive, *options, "--pictures", 3, "--truth", "true_labels") == 0
    assert len(list(out.iterdir())) == 2 * NUM_SCANS + 1
    assert run("label", drive, *options, "--overwrite", "--frames", "1:2") == 0
    assert sorted(file.name for file in out.iterdir()) == ["000001.label", "000001.png"]
    (tmp_path / "kitti").mkdir()
    (write_kitti_sequence(tmp_path / "kitti", num_scans=1) / "000000.bin").write_bytes(b"broken")
    assert run("label", tmp_path / "kitti", *options, "--overwrite") == 2  # nothing was labelled instead
    assert sorted(file.name for file in out.iterdir()) == ["000001.label", "000001.png"]


def test_an_unreadable_scan_is_skipped_with_a_warning(
    drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    root = tmp_path / "kitti"
    (write_kitti_sequence(root, num_scans=2) / "000000.bin").write_bytes(b"broken")
    figures = _labelled(root, tmp_path / "out", capsys, "--labels", "geometric")
    assert figures["num_scans"] == 1
    assert "000000.bin" in caplog.text
    assert [file.name for file in (tmp_path / "out").glob("*.label")] == ["000001.label"]


def test_scores_are_intersections_over_unions_of_the_points_whose_class_is_known() -> None:
    rng = np.random.default_rng(0)
    labels, truth = rng.integers(0, 26, 5000).astype(np.uint8), rng.integers(0, 26, 5000).astype(np.uint8)
    labels[:2000] = truth[:2000]
    counts = confusion(labels, truth)
    given, true = STILL[labels][truth > 0], STILL[truth][truth > 0]
    assert Label(int(STILL[Label.MOVING_CAR])) == Label.CAR
    by_class = class_scores(counts)
    assert len(by_class) == 19
    for label in list(Label)[1:20]:
        expected = ((given == label) & (true == label)).sum() / ((given == label) | (true == label)).sum()
        assert by_class[label.name.lower()] == pytest.approx(expected)
    upright = [Label.TRUNK, Label.POLE]
    both, either = np.isin(given, upright) & np.isin(true, upright), np.isin(given, upright) | np.isin(true, upright)
    assert scores(counts, GROUPS)["trunk_or_pole"] == pytest.approx(both.sum() / either.sum())
    right, wrong, share = largest_confusions(counts, 1)[0]
    assert share == pytest.approx(((true == right) & (given == wrong)).mean())
    assert right != wrong


@pytest.mark.long
@pytest.mark.data
def test_geometric_labels_on_real_scans_score_as_measured(
    data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ("--labels", "geometric", "--frames", "0:1", "--truth", data_dir / "kitti/sequences/00/labels")
    figures = _labelled(data_dir / "kitti", tmp_path / "out", capsys, *options)
    groups = figures["iou_of_groups"]
    assert groups["ground"] > 0.9
    assert groups["car"] > 0.7
    assert groups["building"] > 0.6
    raw = read_ids(tmp_path / "out" / "000000.label")
    assert len(raw) == 124668
    assert set(np.unique(raw)) <= set(RAW_OF_LABEL.tolist())
