"""The Python of the page on networks, followed: needs torch and onnxscript, which the package itself does not."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.made_networks import HEIGHT, SETTINGS, WIDTH, one_point_a_pixel

from segslam.labels.network import Network
from segslam.labels.network_settings import NetworkSettings
from segslam.labels.range_image import Projection, network_input

pytest.importorskip("onnxscript")
torch = pytest.importorskip("torch")
pytestmark = pytest.mark.filterwarnings("ignore")  # those of torch's exporter

PAGE = Path(__file__).resolve().parents[2] / "docs" / "network_labels.md"
SIZE = {"height": HEIGHT, "width": WIDTH - 2}  # of whole blocks of 4 x 4 pixels
SIDE = 4


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """What the page's Python defines."""
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL):
        exec(block, names)
    return names


def _write_settings(folder: Path, num_classes: int) -> None:
    import yaml

    (folder / "net.yaml").write_text(yaml.safe_dump(SETTINGS | SIZE | {"classes": list(range(num_classes))}))


class TwoHeads(torch.nn.Module):
    """Convolutions with normalisation and dropout, a main head and an auxiliary one."""

    def __init__(self) -> None:
        super().__init__()
        self.body = torch.nn.Sequential(
            torch.nn.Conv2d(5, 8, 3, padding=1), torch.nn.BatchNorm2d(8), torch.nn.LeakyReLU(), torch.nn.Dropout2d(0.5)
        )
        self.main, self.aside = torch.nn.Conv2d(8, 4, 1), torch.nn.Conv2d(8, 4, 1)

    def forward(self, image: Any) -> list[Any]:
        features = self.body(image)
        return [self.main(features), self.aside(features)]


class OfGroupedPoints(torch.nn.Module):
    """Takes an image of 11 channels and the points of its blocks, as 3D-MiniNet does."""

    def __init__(self) -> None:
        super().__init__()
        self.points = torch.nn.Conv2d(11, 4, (SIDE**2, 1))
        self.image = torch.nn.Conv2d(11, 4, 3, padding=1)

    def forward(self, inputs: list[Any]) -> Any:
        image, points = inputs
        rows, columns = image.shape[2] // SIDE, image.shape[3] // SIDE
        blocks = self.points(points).reshape(1, 4, rows, columns)
        return self.image(image) + torch.nn.functional.interpolate(blocks, scale_factor=SIDE)


def test_each_activation_is_replaced_also_in_parts_of_parts(page: dict[str, Any]) -> None:
    model = torch.nn.Sequential(TwoHeads(), torch.nn.LeakyReLU(), torch.nn.ReLU())
    page["replace_activation"](model, torch.nn.Hardswish())
    kinds = [type(part).__name__ for part in model.modules()]
    assert kinds.count("Hardswish") == 1  # one module, in two places
    assert "LeakyReLU" not in kinds
    assert isinstance(model[0].body[2], torch.nn.Hardswish)
    assert isinstance(model[1], torch.nn.Hardswish)


@pytest.mark.parametrize("wrapped", ["state_dict", "model", None])
def test_an_exported_network_labels_as_in_torch(tmp_path: Path, page: dict[str, Any], wrapped: str | None) -> None:
    torch.manual_seed(0)
    trained, model = TwoHeads(), TwoHeads()
    state = {f"module.{name}": value for name, value in trained.state_dict().items()}
    torch.save({wrapped: state, "epoch": 3} if wrapped else state, tmp_path / "checkpoint")
    model.load_state_dict(page["weights"](tmp_path / "checkpoint"))
    page["export"](model, tmp_path / "net.onnx", **SIZE)
    assert [file.name for file in tmp_path.glob("net*")] == ["net.onnx"]
    _write_settings(tmp_path, 4)
    network = Network(tmp_path / "net.onnx")
    image = np.random.default_rng(0).normal(size=(1, 5, *SIZE.values())).astype(np.float32)
    with torch.no_grad():
        expected = trained.eval()(torch.from_numpy(image))[0][0].argmax(dim=0)
    np.testing.assert_array_equal(network.label_image(image), expected)


def test_grouped_points_are_those_that_a_plain_loop_makes(page: dict[str, Any]) -> None:
    settings = NetworkSettings.model_validate(SETTINGS | SIZE)
    points, intensities = (rows[::2] for rows in one_point_a_pixel())
    projection = Projection(points, settings=settings)
    image = network_input(points, intensities, projection, settings=settings)
    taken: list[Any] = []
    wrapper = page["GroupedPoints"](taken.extend, list(settings.mean), list(settings.std))
    wrapper(torch.from_numpy(image))
    whole, grouped = (np.asarray(part[0]) for part in taken)
    np.testing.assert_array_equal(whole[:5], image[0])
    channels = np.column_stack([projection.ranges_m, points, intensities])
    num_columns = settings.width // SIDE
    for block in range(grouped.shape[2]):
        top, left = SIDE * (block // num_columns), SIDE * (block % num_columns)
        at = projection.nearest[top : top + SIDE, left : left + SIDE].ravel()
        seen = at >= 0
        relative = np.zeros((SIDE**2, 5))
        if seen.any():
            relative[seen] = channels[at[seen]] - channels[at[seen]].mean(axis=0)
        np.testing.assert_allclose(grouped[5:10, :, block].T, relative, atol=1e-4)
        np.testing.assert_allclose(grouped[10, :, block], np.linalg.norm(relative[:, 1:4], axis=1), atol=1e-4)
        square = whole[:, top : top + SIDE, left : left + SIDE].reshape(11, -1)
        np.testing.assert_array_equal(grouped[:, :, block], square)


def test_a_network_of_grouped_points_is_exported_with_one_input(tmp_path: Path, page: dict[str, Any]) -> None:
    torch.manual_seed(0)
    settings = NetworkSettings.model_validate(SETTINGS | SIZE)
    model = page["GroupedPoints"](OfGroupedPoints(), list(settings.mean), list(settings.std))
    page["export"](model, tmp_path / "net.onnx", **SIZE)
    _write_settings(tmp_path, 4)
    points, intensities = one_point_a_pixel()
    projection = Projection(points, settings=settings)
    image = network_input(points, intensities, projection, settings=settings)
    with torch.no_grad():
        expected = model(torch.from_numpy(image))[0].argmax(dim=0).numpy()
    labels = Network(tmp_path / "net.onnx").label_image(image)
    assert (labels == expected).mean() > 0.999  # equal logits are rare
    assert len(np.unique(labels)) > 1
