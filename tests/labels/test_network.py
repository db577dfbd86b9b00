"""Generated networks: each point gets the class of its pixel, and mismatches are reported."""

import json
import logging
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from helpers.commands import run
from helpers.made_networks import HEIGHT, WIDTH, expected_classes, made_network, one_point_a_pixel, save_network
from onnx import TensorProto, helper

from segslam.core.config import OdometryConfig
from segslam.core.types import Label, SegslamError
from segslam.labels.label_files import computed, open_labels
from segslam.labels.network import Network
from segslam.labels.network_settings import read_settings
from segslam.odometry.sweep import deskew_scan
from segslam.scans import open_dataset

LABELS = np.array([Label.ROAD, Label.CAR, Label.POLE], dtype=np.uint8)
DOCS = Path(__file__).resolve().parents[2] / "docs" / "network_labels.md"


@pytest.mark.parametrize("ids", [False, True])
def test_each_point_gets_the_class_that_the_network_gives_its_pixel(tmp_path: Path, ids: bool) -> None:
    points, intensities = one_point_a_pixel()
    labels = Network(made_network(tmp_path, ids=ids)).labels(points, intensities)
    np.testing.assert_array_equal(labels, LABELS[expected_classes(points, intensities)])
    assert len(np.unique(labels)) == 3


def test_labels_go_with_their_points_in_whatever_order(tmp_path: Path) -> None:
    network = Network(made_network(tmp_path, votes={"window": 5}))
    points, intensities = one_point_a_pixel()
    order = np.random.default_rng(2).permutation(len(points))
    np.testing.assert_array_equal(
        network.labels(points[order], intensities[order]), network.labels(points, intensities)[order]
    )


def test_points_that_are_no_return_stay_unlabelled(tmp_path: Path) -> None:
    points = np.array([[np.nan, 1, 1], [0, 0, 0], [np.inf, 0, 0], [9, 0, 0]])
    labels = Network(made_network(tmp_path)).labels(points, np.zeros(4))
    assert (labels == Label.UNLABELLED).tolist() == [True, True, True, False]
    assert Network(made_network(tmp_path)).labels(points[:0], np.zeros(0)).shape == (0,)


@pytest.mark.parametrize("ids", [False, True])
def test_intensities_that_are_no_number_are_zeros(tmp_path: Path, ids: bool) -> None:
    points, intensities = one_point_a_pixel()
    broken, zeros = intensities.copy(), intensities.copy()
    broken[[3, 50, 700]] = np.nan, np.inf, -np.inf
    zeros[[3, 50, 700]] = 0.0
    network = Network(made_network(tmp_path, ids=ids))
    np.testing.assert_array_equal(network.labels(points, broken), network.labels(points, zeros))


def test_sizes_that_the_model_leaves_open_fit_any_settings(tmp_path: Path) -> None:
    points, intensities = one_point_a_pixel()
    fixed, free = tmp_path / "fixed", tmp_path / "free"
    fixed.mkdir(), free.mkdir()
    labels = Network(made_network(free, input_shape=("n", 5, "h", "w"))).labels(points, intensities)
    np.testing.assert_array_equal(labels, Network(made_network(fixed)).labels(points, intensities))


def _two_inputs(folder: Path) -> Path:
    ports = [helper.make_tensor_value_info(name, TensorProto.FLOAT, (1, 5, HEIGHT, WIDTH)) for name in "abc"]
    return save_network(
        folder, helper.make_graph([helper.make_node("Add", ["a", "b"], ["c"])], "two", ports[:2], ports[2:])
    )


def _without_settings(folder: Path) -> Path:
    model = made_network(folder)
    (folder / "net.yaml").unlink()
    return model


def _truncated(folder: Path) -> Path:
    model = made_network(folder)
    model.write_bytes(model.read_bytes()[:100])
    return model


def _weights_elsewhere(folder: Path) -> Path:
    model = made_network(folder)
    onnx.save(onnx.load(model), model, save_as_external_data=True, location="net.onnx.data", size_threshold=0)
    (folder / "net.onnx.data").unlink()
    return model


def _made(**options: Any) -> Callable[[Path], Path]:
    return lambda folder: made_network(folder, **options)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda folder: folder / "none.onnx", r"none\.onnx: no such file"),
        (_without_settings, r"net\.yaml: no such file"),
        (_truncated, r"net\.onnx: onnxruntime cannot load it"),
        (_weights_elsewhere, r"in a separate file, net\.onnx\.data: put it beside.*external_data=False"),
        (_two_inputs, r"takes the inputs a: tensor\(float\), b: tensor\(float\); expected a single input"),
        (_made(classes=["road", "car"]), r"gives logits of 1 x 3 x 16 x 90, but net\.yaml requires 1 x 2 x 16 x 90"),
        (_made(height=32), r"takes an image of 1 x 5 x 16 x 90, but net\.yaml makes one of 1 x 5 x 32 x 90"),
        (
            _made(channels=["range", "x", "y", "z"], mean=[0] * 4, std=[1] * 4),
            r"takes an image of 1 x 5 x 16 x 90, but net\.yaml makes one of 1 x 4 x 16 x 90",
        ),
        (_made(input_shape=(1, 5, "h", "w"), weights=np.full((3, 5), np.nan)), r"logits that are not finite"),
        (_made(ids=True, id_offset=7), r"gave class id 7, but net\.yaml names 3 classes, ids 0 to 2"),
        (_made(ids=True, id_offset=-1), r"gave class id -1, but net\.yaml names 3 classes"),
        (_made(azimuth_deg=[-45, 45]), r"net\.yaml: .*azimuth_deg: -45 to 45; .*full circle"),
        (_made(azimuth_deg=[0, 360]), r"net\.yaml: .*azimuth_deg: 0 to 360; .*full circle"),
        (_made(mean=[0.0]), r"net\.yaml: .*mean: 1 numbers for 5 channels"),
        (_made(field_of_view_deg=[3.0, -25.0]), r"net\.yaml: .*lowest elevation, then the highest"),
        (_made(classes=["road", "castle"]), r"net\.yaml: classes\.1: .*no such class"),
        (_made(colour="red"), r"net\.yaml: unknown key colour; known keys: field_of_view_deg, height"),
        (_made(votes={"window": 4}), r"net\.yaml: votes\.window: .*odd"),
    ],
)
def test_mismatches_are_reported_when_a_network_is_opened(
    tmp_path: Path, make: Callable[[Path], Path], expected: str
) -> None:
    with pytest.raises(SegslamError, match=expected):
        Network(make(tmp_path))


def test_ids_of_another_shape_are_refused_with_both_shapes(tmp_path: Path) -> None:
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, (1, 5, HEIGHT, WIDTH))
    ids = helper.make_tensor_value_info("ids", TensorProto.INT64, None)
    graph = helper.make_graph([helper.make_node("ArgMax", ["image"], ["ids"], axis=3, keepdims=0)], "g", [image], [ids])
    with pytest.raises(SegslamError, match=r"class ids of 1 x 5 x 16, but net\.yaml requires 1 x 16 x 90 or"):
        Network(save_network(tmp_path, graph))


def test_missing_package_is_named_with_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(SegslamError, match="pip install 'onnxruntime<"):
        Network(made_network(tmp_path))


def test_intensities_of_a_drive_reach_the_network(tmp_path: Path) -> None:
    points, intensities = one_point_a_pixel()
    velodyne = tmp_path / "drive" / "velodyne"
    velodyne.mkdir(parents=True)
    np.column_stack([points, intensities]).astype(np.float32).tofile(velodyne / "0.bin")
    scan = open_dataset(tmp_path / "drive", labels=f"network:{made_network(tmp_path)}")[0]
    expected = LABELS[expected_classes(points, intensities)]
    assert (computed(scan.labels) == expected).mean() > 0.99  # float32 moves a few points over an edge
    assert (expected == Label.CAR).any()


def test_late_labels_lose_the_rows_that_their_points_lose(tmp_path: Path) -> None:
    points, intensities = one_point_a_pixel()
    velodyne = tmp_path / "drive" / "velodyne"
    velodyne.mkdir(parents=True)
    returns = np.column_stack([points, intensities]).astype(np.float32)
    returns[::7, :3] = 0
    returns[3::7, :3] = np.nan
    returns.tofile(velodyne / "0.bin")
    network = made_network(tmp_path)
    scan = open_dataset(tmp_path / "drive", labels=f"network:{network}")[0]
    kept_points, labels, _ = deskew_scan(scan, np.eye(4), OdometryConfig(min_range_m=10, max_range_m=20))
    ranges_m = np.linalg.norm(np.nan_to_num(returns[:, :3].astype(np.float64)), axis=1)
    rows = np.flatnonzero((ranges_m > 10) & (ranges_m < 20))
    assert 100 < len(rows) == len(kept_points)
    expected = Network(network).labels(returns[:, :3], returns[:, 3])[rows]
    np.testing.assert_array_equal(computed(labels), expected)
    assert len(np.unique(expected)) == 3


def test_unknown_intensities_are_zeros_with_one_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    points, _ = one_point_a_pixel()
    source = open_labels(f"network:{made_network(tmp_path)}", beside=tmp_path, scan_names=["0"], encoding=None)
    assert not source.geometric
    with caplog.at_level(logging.WARNING):
        labels = [computed(source.read("0", points)) for _ in range(2)]
    assert caplog.text.count("receives zeros") == 1
    np.testing.assert_array_equal(labels[0], LABELS[expected_classes(points, np.zeros(len(points)))])
    np.testing.assert_array_equal(labels[0], labels[1])


@pytest.mark.parametrize("before", [True, False])
def test_register_labels_both_scans_by_one_network(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], before: bool
) -> None:
    points, intensities = one_point_a_pixel()
    np.save(tmp_path / "scan.npy", np.column_stack([points, intensities]))
    labels = ["--labels", f"network:{made_network(tmp_path)}"]
    options = [*labels, "--json"] if before else ["--json", *labels]
    assert run("register", tmp_path / "scan.npy", tmp_path / "scan.npy", *options) == 0
    output = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(np.reshape(output["T_target_source"], (4, 4)), np.eye(4), atol=1e-6)
    assert output["seconds"]["label"] > 0


def test_settings_in_the_documentation_are_complete(tmp_path: Path) -> None:
    blocks = re.findall(r"```yaml\n(.*?)```", DOCS.read_text(encoding="utf-8"), flags=re.DOTALL)
    (example,) = (block for block in blocks if "classes:" in block)
    (tmp_path / "model.yaml").write_text(example)
    settings = read_settings(tmp_path / "model.yaml")
    assert (settings.height, settings.width, len(settings.classes)) == (64, 2048, 20)
    assert settings.classes == tuple(Label(number) for number in range(20))


def test_python_in_the_documentation_compiles() -> None:
    for block in re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), flags=re.DOTALL):
        compile(block, str(DOCS), "exec")
