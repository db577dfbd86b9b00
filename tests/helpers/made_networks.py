"""Small range-image networks in ONNX format, with the YAML file that belongs to each."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import yaml
from onnx import TensorProto, helper, numpy_helper

HEIGHT, WIDTH = 16, 90
SETTINGS: dict[str, Any] = {
    "field_of_view_deg": [-20.0, 20.0],
    "height": HEIGHT,
    "width": WIDTH,
    "mean": [10.0, 1.0, -1.0, 0.5, 0.25],
    "std": [5.0, 4.0, 3.0, 2.0, 0.5],
    "classes": ["road", "car", "pole"],
    "votes": {"window": 1, "neighbours": 1},
}
CLASS_WEIGHTS = np.array([[0, 0, 0, -2, 0], [0, 0, 0, 0, 3], [0.5, 0, 0, 1, 0]], np.float32)
"""Logits of each class from range, x, y, z and intensity, normalised: low, bright, far high things."""


def made_network(
    folder: Path,
    *,
    ids: bool = False,
    input_shape: tuple[int | str, ...] = (1, 5, HEIGHT, WIDTH),
    weights: np.ndarray = CLASS_WEIGHTS,
    id_offset: int = 0,
    **changed: Any,
) -> Path:
    """A network of one 1 x 1 convolution, giving logits, or class ids; `changed` goes into its YAML file."""
    kernel = numpy_helper.from_array(weights[:, :, None, None].astype(np.float32), "kernel")
    nodes = [helper.make_node("Conv", ["image", "kernel"], ["logits"])]
    constants = [kernel]
    if ids:
        constants.append(numpy_helper.from_array(np.array(id_offset), "offset"))
        nodes += [
            helper.make_node("ArgMax", ["logits"], ["best"], axis=1, keepdims=0),
            helper.make_node("Add", ["best", "offset"], ["ids"]),
        ]
    output = helper.make_tensor_value_info(
        "ids" if ids else "logits", TensorProto.INT64 if ids else TensorProto.FLOAT, None
    )
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, input_shape)
    return save_network(folder, helper.make_graph(nodes, "made", [image], [output], constants), **changed)


def class_network(folder: Path, **changed: Any) -> Path:
    """A network that takes learning ids as intensities, and returns them: its logits are x c - c^2 / 2."""
    ids = np.arange(20, dtype=np.float32)
    constants = [
        numpy_helper.from_array(ids[:, None, None, None], "kernel"),
        numpy_helper.from_array(-(ids**2) / 2, "bias"),
    ]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, (1, 1, "height", "width"))
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, None)
    graph = helper.make_graph(
        [helper.make_node("Conv", ["image", "kernel", "bias"], ["logits"])], "classes", [image], [logits], constants
    )
    one_channel = {"channels": ["intensity"], "mean": [0.0], "std": [1.0], "classes": list(range(20))}
    return save_network(folder, graph, **(one_channel | changed))


def save_network(folder: Path, graph: onnx.GraphProto, **changed: Any) -> Path:
    """Writes the graph as `net.onnx`, in an old enough version for any runtime, and `net.yaml`."""
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    file = folder / "net.onnx"
    onnx.save(model, file)
    (folder / "net.yaml").write_text(yaml.safe_dump(SETTINGS | changed))
    return file


def expected_classes(points: np.ndarray, intensities: np.ndarray) -> np.ndarray:
    """The class of each point by that convolution, computed from the point alone."""
    channels = np.column_stack([np.linalg.norm(points, axis=1), points, intensities])
    normalised = (channels - np.array(SETTINGS["mean"])) / np.array(SETTINGS["std"])
    return (normalised @ CLASS_WEIGHTS.T).argmax(axis=1)


def one_point_a_pixel() -> tuple[np.ndarray, np.ndarray]:
    """Points in the middle of each pixel, at ranges and with intensities of their own."""
    rng = np.random.default_rng(0)
    rows, columns = np.indices((HEIGHT, WIDTH)) + 0.5
    elevation, azimuth = np.radians(20 - 40 * rows / HEIGHT).ravel(), (np.pi - 2 * np.pi * columns / WIDTH).ravel()
    directions = np.column_stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    return directions * rng.uniform(3, 30, (len(directions), 1)), rng.uniform(0, 1, len(directions))
