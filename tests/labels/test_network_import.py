"""The files published with networks, read instead of a YAML file."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers.made_networks import made_network

from segslam.core.types import Label, SegslamError
from segslam.labels.encodings import RAW_OF_LABEL
from segslam.labels.network import Network
from segslam.labels.network_settings import DATA, read_settings, settings_file

PAGE = Path(__file__).resolve().parents[2] / "docs" / "network_labels.md"
SENSOR: dict[str, Any] = {
    "name": "HDL64",
    "type": "spherical",
    "fov_up": 3,
    "fov_down": -25,
    "img_prop": {"width": 2048, "height": 64},
    "img_means": [12.12, 10.88, 0.23, -1.04, 0.21],
    "img_stds": [12.32, 11.47, 6.91, 0.86, 0.16],
}
VOTES: dict[str, Any] = {"use": True, "params": {"knn": 7, "search": 9, "sigma": 1.5, "cutoff": 2.0}}
NAMES = {
    int(raw): label.name.lower().replace("_", "-")
    for raw, label in zip(RAW_OF_LABEL[1:20], list(Label)[1:20], strict=True)
} | {0: "unlabeled"}
INVERSE = {int(label): int(RAW_OF_LABEL[label]) for label in list(Label)[:20]}


def _architecture(votes: dict[str, Any] = VOTES, **sensor: Any) -> dict[str, Any]:
    """As lidar-bonnetal writes it, with keys that are about training."""
    return {
        "train": {"loss": "xentropy", "lr": 0.005},
        "backbone": {"name": "darknet", "input_depth": {"range": True, "xyz": True, "remission": True}},
        "post": {"CRF": {"use": False, "train": True, "params": False}, "KNN": votes},
        "dataset": {"labels": "kitti", "scans": "kitti", "max_points": 150000, "sensor": SENSOR | sensor},
    }


def _write(folder: Path, architecture: Any, classes: Any = None) -> Path:
    """The files of a published network; returns that of its image."""
    (folder / "arch_cfg.yaml").write_text(yaml.safe_dump(architecture))
    classes = classes or {"name": "kitti", "labels": NAMES, "learning_map_inv": INVERSE, "split": {"train": [0]}}
    (folder / "data_cfg.yaml").write_text(yaml.safe_dump(classes))
    return folder / "arch_cfg.yaml"


def test_published_files_give_image_classes_and_votes(tmp_path: Path) -> None:
    settings = read_settings(_write(tmp_path, _architecture()))
    assert settings.field_of_view_deg == (-25, 3)
    assert (settings.height, settings.width) == (64, 2048)
    assert settings.channels == ("range", "x", "y", "z", "intensity")
    assert settings.mean == (12.12, 10.88, 0.23, -1.04, 0.21)
    assert settings.std == (12.32, 11.47, 6.91, 0.86, 0.16)
    assert settings.classes == tuple(Label(number) for number in range(20))
    votes = settings.votes
    assert (votes.window, votes.neighbours, votes.sigma_px, votes.cutoff_m) == (9, 7, 1.5, 2.0)


def test_votes_that_are_not_used_leave_each_point_the_class_of_its_pixel(tmp_path: Path) -> None:
    settings = read_settings(_write(tmp_path, _architecture({"use": False, "params": VOTES["params"]})))
    assert (settings.votes.window, settings.votes.neighbours) == (1, 1)


def test_no_cutoff_is_a_cutoff_beyond_all_ranges(tmp_path: Path) -> None:
    votes = {"use": True, "params": VOTES["params"] | {"cutoff": 0.0}}
    assert read_settings(_write(tmp_path, _architecture(votes))).votes.cutoff_m > 1e5


def test_classes_are_matched_by_their_names(tmp_path: Path) -> None:
    names = {5: "on-rails", 7: "lane-marking", 9: "other-object", 11: "moving-car", 3: "traffic sign"}
    classes = {"labels": names, "learning_map_inv": {0: 9, 1: 7, 2: 5, 3: 11, 4: 3}}
    settings = read_settings(_write(tmp_path, _architecture(), classes))
    expected = (Label.UNLABELLED, Label.ROAD, Label.OTHER_VEHICLE, Label.MOVING_CAR, Label.TRAFFIC_SIGN)
    assert settings.classes == expected


def test_own_keys_replace_imported_ones(tmp_path: Path) -> None:
    own = _write(tmp_path, _architecture()).with_name("net.yaml")
    own.write_text("import: arch_cfg.yaml\nmean: [12, 10, 0, -1, 53]\nstd: [12, 11, 6, 1, 40]\n")
    settings = read_settings(own)
    assert settings.mean[-1] == 53
    assert settings.width == 2048


def test_the_example_of_the_page_replaces_the_scale_of_intensities(tmp_path: Path) -> None:
    blocks = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    own = _write(tmp_path, _architecture()).with_name("net.yaml")
    own.write_text(next(block for block in blocks if "import:" in block))
    settings = read_settings(own)
    published = SENSOR["img_means"], SENSOR["img_stds"]
    for scaled, values in zip((settings.mean, settings.std), published, strict=True):
        assert scaled == pytest.approx((*values[:4], 255 * values[4]))


def test_own_classes_need_no_published_ones(tmp_path: Path) -> None:
    own = _write(tmp_path, _architecture()).with_name("net.yaml")
    (tmp_path / "data_cfg.yaml").unlink()
    own.write_text("import: arch_cfg.yaml\nclasses: [road, car]\n")
    assert read_settings(own).classes == (Label.ROAD, Label.CAR)


def test_a_published_file_may_have_the_models_name(tmp_path: Path) -> None:
    model = tmp_path / "net.onnx"
    _write(tmp_path, _architecture()).rename(model.with_suffix(".yaml"))
    assert settings_file(model).name == "net.yaml"
    assert read_settings(settings_file(model)).width == 2048


def test_a_network_opens_with_the_files_that_it_ships(tmp_path: Path) -> None:
    model = made_network(tmp_path)
    settings_file(model).unlink()
    names = {"labels": {0: "road", 1: "car", 2: "pole"}, "learning_map_inv": {0: 0, 1: 1, 2: 2}}
    _write(tmp_path, _architecture(img_prop={"width": 90, "height": 16}), names)
    assert Network(model).settings.classes == (Label.ROAD, Label.CAR, Label.POLE)


def _without_classes(folder: Path) -> Path:
    own = _write(folder, _architecture())
    own.with_name(DATA).unlink()
    return own


def _imports_nothing(folder: Path) -> Path:
    (folder / "net.yaml").write_text("import: elsewhere/arch_cfg.yaml\n")
    return folder / "net.yaml"


def _with(architecture: dict[str, Any], classes: Any = None) -> Callable[[Path], Path]:
    return lambda folder: _write(folder, architecture, classes)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (_without_classes, r"data_cfg\.yaml: no such file; .*semantic-kitti\.yaml"),
        (_imports_nothing, r"elsewhere/arch_cfg\.yaml: no such file"),
        (_with(_architecture(fov_left=-45, fov_right=45)), r"azimuth_deg: -45 to 45; .*full circle"),
        (_with(_architecture(img_means=[0] * 8, img_stds=[1] * 8)), r"img_means: .*8 numbers; expected 5.*normals"),
        (_with(_architecture(type="cylindrical")), r"arch_cfg\.yaml: dataset\.sensor\.type: .*'spherical'"),
        (_with({"dataset": {"sensor": {}}}), r"arch_cfg\.yaml: dataset\.sensor\.fov_up: Field required"),
        (
            _with(_architecture(), {"labels": {4: "people"}, "learning_map_inv": {0: 4}}),
            r"data_cfg\.yaml: people is not a class of SemanticKITTI; .*`import: arch_cfg\.yaml`",
        ),
        (_with(_architecture(), {"labels": NAMES, "learning_map_inv": {1: 10}}), r"data_cfg\.yaml: output 0 has no"),
        (_with(_architecture(), {"labels": NAMES}), r"data_cfg\.yaml: learning_map_inv: Field required"),
    ],
)
def test_files_that_cannot_be_used_are_refused_with_the_reason(
    tmp_path: Path, make: Callable[[Path], Path], expected: str
) -> None:
    with pytest.raises(SegslamError, match=expected):
        read_settings(make(tmp_path))
