"""Label files: found, read, kept in step with the points, and refused with both numbers."""

import logging
from pathlib import Path

import numpy as np
import pytest

from segslam.core.types import BadScan, Label, SegslamError
from segslam.labels.label_files import encoding_of, open_labels, read_ids, read_labels, whole_source

NAMES = ["000000", "000001"]


def _write(folder: Path, name: str, ids: list[int], instance: int = 0) -> Path:
    folder.mkdir(exist_ok=True)
    file = folder / f"{name}.label"
    (np.array(ids, dtype="<u4") + (instance << 16)).tofile(file)
    return file


def test_instances_are_left_out(tmp_path: Path) -> None:
    file = _write(tmp_path / "labels", "000000", [10, 40, 252], instance=504)
    np.testing.assert_array_equal(read_ids(file), [10, 40, 252])


def test_labels_beside_the_scans_are_found_by_themselves(tmp_path: Path) -> None:
    for name in NAMES:
        _write(tmp_path / "labels", name, [10, 40, 50])
    source = open_labels("auto", beside=tmp_path, scan_names=NAMES, encoding=None)
    assert (source.folder, source.encoding) == (tmp_path / "labels", "raw")
    np.testing.assert_array_equal(source.read("000001", np.ones((3, 3))), [Label.CAR, Label.ROAD, Label.BUILDING])


def test_without_label_files_labels_are_geometric(tmp_path: Path) -> None:
    source = open_labels("auto", beside=tmp_path, scan_names=NAMES, encoding=None)
    assert source.folder is None
    assert source.geometric
    np.testing.assert_array_equal(source.read("000000", np.ones((2, 3))), [Label.UNLABELLED] * 2)


@pytest.mark.parametrize(("name", "geometric"), [("none", False), ("geometric", True)])
def test_files_are_not_read_unless_requested(tmp_path: Path, name: str, geometric: bool) -> None:
    _write(tmp_path / "labels", "000000", [10, 40])
    source = open_labels(name, beside=tmp_path, scan_names=NAMES, encoding=None)
    assert source.folder is None
    assert source.geometric == geometric


@pytest.mark.parametrize("absolute", [True, False])
def test_folder_is_named_from_the_sequence_or_the_root(tmp_path: Path, absolute: bool) -> None:
    _write(tmp_path / "mine", "000000", [0, 18])
    name = str(tmp_path / "mine") if absolute else "mine"
    source = open_labels(name, beside=tmp_path, scan_names=NAMES, encoding="learning-0")
    assert not source.geometric
    np.testing.assert_array_equal(source.read("000000", np.ones((2, 3))), [Label.CAR, Label.TRAFFIC_SIGN])


def test_scans_without_a_file_stay_unlabelled_and_are_counted_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    _write(tmp_path / "labels", "000000", [10, 40])
    with caplog.at_level(logging.WARNING):
        source = open_labels("auto", beside=tmp_path, scan_names=NAMES, encoding=None)
    assert "1 of 2 scans have no label file" in caplog.text
    np.testing.assert_array_equal(source.read("000001", np.ones((4, 3))), [Label.UNLABELLED] * 4)
    assert source.geometric


def test_labels_of_another_length_are_refused_with_both_numbers(tmp_path: Path) -> None:
    _write(tmp_path, "000000", [10, 40])
    with pytest.raises(BadScan, match=r"000000\.label: 2 labels for 3 points"):
        read_labels(tmp_path / "000000.label", 3, "raw")


@pytest.mark.parametrize("source", ["none", "geometric", "network:model.onnx"])
def test_an_encoding_without_label_files_is_refused(tmp_path: Path, source: str) -> None:
    with pytest.raises(SegslamError, match="only label files have one"):
        open_labels(source, beside=tmp_path, scan_names=NAMES, encoding="learning")


def test_truncated_labels_are_refused(tmp_path: Path) -> None:
    (tmp_path / "000000.label").write_bytes(b"12345")
    with pytest.raises(BadScan, match=r"000000\.label: 5 bytes"):
        read_labels(tmp_path / "000000.label", 1, "raw")


def test_id_of_another_encoding_is_the_scans_failure(tmp_path: Path) -> None:
    _write(tmp_path, "000000", [10, 40])
    with pytest.raises(BadScan, match=r"000000\.label: id 40 is not in the encoding learning"):
        read_labels(tmp_path / "000000.label", 2, "learning")


def test_an_invalid_file_does_not_prevent_detection_of_the_encoding(tmp_path: Path) -> None:
    _write(tmp_path / "labels", "000000", [10, 40])
    (tmp_path / "labels" / "000001.label").write_bytes(b"123")
    source = open_labels("auto", beside=tmp_path, scan_names=NAMES, encoding=None)
    assert (source.folder, source.encoding) == (tmp_path / "labels", "raw")


def test_missing_folder_and_unknown_source_are_named(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match=r"predicted \(a relative path starts beside the scans\); give one"):
        open_labels("predicted", beside=tmp_path, scan_names=NAMES, encoding=None)


def test_folder_without_a_label_for_any_scan_is_refused(tmp_path: Path) -> None:
    _write(tmp_path / "mine", "000007", [10, 40])
    with pytest.raises(SegslamError, match=r"no \.label file for any of the 2 scans"):
        open_labels("mine", beside=tmp_path, scan_names=NAMES, encoding=None)


@pytest.mark.parametrize(
    ("names", "expected"),
    [(["1", "2", "3"], r"mine"), (["1", "2"], r"mine.1\.label and .*mine.2\.label"), (["1"], r"mine.1\.label")],
)
def test_undecided_encoding_names_the_files_or_their_folder_and_the_option(
    tmp_path: Path, names: list[str], expected: str
) -> None:
    for name in names:
        _write(tmp_path / "mine", name, [0, 0, 0])
    with pytest.raises(
        SegslamError, match=expected + r": the numbering of the classes cannot be detected .*--encoding"
    ):
        open_labels("mine", beside=tmp_path, scan_names=names, encoding=None)


def test_missing_network_is_named(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match=r"model\.onnx: no such file"):
        open_labels("network:model.onnx", beside=tmp_path, scan_names=NAMES, encoding=None)


@pytest.mark.data
@pytest.mark.parametrize("name", ["000000", "000020", "000030", "004413"])
def test_the_encoding_of_each_real_prediction_is_detected_from_one_file(data_dir: Path, name: str) -> None:
    sequence = data_dir / "kitti" / "sequences" / "00"
    source = open_labels("predicted_labels", beside=sequence, scan_names=[name], encoding=None)
    assert (source.folder, source.encoding) == (sequence / "predicted_labels", "learning-0")


@pytest.mark.data
def test_real_predictions_agree_with_the_real_truth(data_dir: Path) -> None:
    sequence = data_dir / "kitti" / "sequences" / "00"
    truth, prediction = (
        open_labels(source, beside=sequence, scan_names=["000000"], encoding=None).read("000000", np.ones((124668, 3)))
        for source in ("labels", "predicted_labels")
    )
    known = truth != Label.UNLABELLED
    assert np.mean(truth[known] == prediction[known]) > 0.9  # chance is about 0.2, the network's accuracy some 0.9


@pytest.mark.parametrize("source", ["~unknown-user/labels", "network:~unknown-user/model.onnx"])
def test_the_home_of_an_unknown_user_is_refused(tmp_path: Path, source: str) -> None:
    with pytest.raises(SegslamError, match=r"~unknown-user/.*: there is no user with this name"):
        open_labels(source, beside=tmp_path, scan_names=NAMES, encoding=None)


@pytest.mark.parametrize(
    ("content", "why"), [(b"123", r"000000\.label: 3 bytes are not a multiple of 4"), (b"", "no file has a label")]
)
def test_files_without_any_label_do_not_decide_the_encoding(tmp_path: Path, content: bytes, why: str) -> None:
    """The reason is that of the files: --encoding would not help."""
    (tmp_path / "000000.label").write_bytes(content)
    with pytest.raises(SegslamError, match=f"cannot be detected: .*{why}"):
        encoding_of([tmp_path / "000000.label"] * 3)


def test_a_network_is_named_in_full_for_use_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert whole_source("network:m.onnx") == f"network:{tmp_path / 'm.onnx'}"
    assert whole_source("network:/a/m.onnx") == "network:/a/m.onnx"
    assert whole_source("labels") == "labels", "those of a folder start at the data"
