"""A small network, trained on simulated scans in seconds: random convolutions, then least squares for the classes."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from helpers.made_networks import save_network
from segslam.bench.labelling import NUM_CLASSES, STILL
from segslam.bench.simulation.files import uncorrected
from segslam.bench.simulation.sensor import Sweep
from segslam.labels.network_settings import NetworkSettings
from segslam.labels.range_image import EMPTY, Projection, network_input

SETTINGS: dict[str, Any] = {
    "field_of_view_deg": [-22.8, 22.5],
    "height": 64,
    "width": 1024,
    "channels": ["range", "z", "intensity", "mask"],
    "mean": [12.0, 0.0, 0.2, 0.0],
    "std": [12.0, 1.5, 0.15, 1.0],
    "classes": list(range(NUM_CLASSES)),
    "votes": {"window": 5, "neighbours": 5},
}
PATCH = (5, 5)
STRIDES = (1, 2, 6)
"""Dilations: a patch of neighbours, and two that see farther."""
NUM_FEATURES = 96
RIDGE = 1e-5


def train_network(folder: Path, sweeps: Iterable[Sweep], *, pixels_per_scan: int = 6000) -> Path:
    """The ONNX file of a network that labels like the sweeps."""
    rng = np.random.default_rng(0)
    settings = NetworkSettings.model_validate(SETTINGS)
    num_channels = len(settings.channels)
    kernels = [rng.normal(size=(NUM_FEATURES, num_channels, *PATCH)) for _ in STRIDES]
    for kernel in kernels:
        kernel[: NUM_FEATURES * 3 // 4, 0] -= kernel[: NUM_FEATURES * 3 // 4, 0].mean(axis=(1, 2), keepdims=True)
        kernel /= 0.5 * np.sqrt(kernel[0].size)
    biases = [rng.uniform(-1.0, 1.0, NUM_FEATURES) for _ in STRIDES]
    rows, targets = [], []
    for one in sweeps:
        points = uncorrected(one.points)
        projection = Projection(points, settings=settings)
        image = network_input(points, one.intensity, projection, settings=settings)[0]
        pixels = np.argwhere(projection.nearest != EMPTY)
        pixels = pixels[rng.choice(len(pixels), pixels_per_scan, replace=False)]
        features = [_features(image, pixels, *each) for each in zip(kernels, biases, STRIDES, strict=True)]
        rows.append(np.column_stack([*features, np.ones(len(pixels))]))
        targets.append(np.eye(NUM_CLASSES)[STILL[one.labels[projection.nearest[*pixels.T]]]])
    A, B = np.concatenate(rows), np.concatenate(targets)
    rare_first = B @ (1.0 / np.sqrt(np.maximum(B.sum(axis=0), 1.0)))  # poles are few, and would never be chosen
    weighted = A * (rare_first / rare_first.mean())[:, None]
    weights = np.linalg.solve(weighted.T @ A + RIDGE * len(A) * np.eye(A.shape[1]), weighted.T @ B)
    return _save(folder, kernels, biases, weights)


def _features(image: np.ndarray, pixels: np.ndarray, kernel: np.ndarray, bias: np.ndarray, stride: int) -> np.ndarray:
    """What the convolution gives at some pixels, zeros beyond the border."""
    margin = stride * (PATCH[0] // 2)
    padded = np.pad(image, ((0, 0), (margin, margin), (margin, margin)))
    offsets = stride * np.arange(PATCH[0])
    down, right = np.meshgrid(offsets, offsets, indexing="ij")
    patches = padded[:, pixels[:, 0, None, None] + down, pixels[:, 1, None, None] + right]
    return np.maximum(np.tensordot(patches, kernel, axes=([0, 2, 3], [1, 2, 3])) + bias, 0.0)


def _save(folder: Path, kernels: list[np.ndarray], biases: list[np.ndarray], weights: np.ndarray) -> Path:
    """As convolutions, a rectifier, and a 1 x 1 convolution to the classes."""
    constants, nodes = [], []
    for number, (kernel, bias, stride) in enumerate(zip(kernels, biases, STRIDES, strict=True)):
        margin = stride * (PATCH[0] // 2)
        constants += [_constant(f"kernel{number}", kernel), _constant(f"bias{number}", bias)]
        nodes.append(
            helper.make_node(
                "Conv",
                ["image", f"kernel{number}", f"bias{number}"],
                [f"conv{number}"],
                dilations=[stride, stride],
                pads=[margin] * 4,
            )
        )
    constants += [_constant("classes", weights[:-1].T[:, :, None, None]), _constant("offset", weights[-1])]
    nodes += [
        helper.make_node("Concat", [f"conv{number}" for number in range(len(kernels))], ["all"], axis=1),
        helper.make_node("Relu", ["all"], ["features"]),
        helper.make_node("Conv", ["features", "classes", "offset"], ["logits"]),
    ]
    shape = (1, len(SETTINGS["channels"]), SETTINGS["height"], SETTINGS["width"])
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)
    logits = helper.make_tensor_value_info("logits", TensorProto.FLOAT, None)
    return save_network(folder, helper.make_graph(nodes, "trained", [image], [logits], constants), **SETTINGS)


def _constant(name: str, values: np.ndarray) -> Any:
    return numpy_helper.from_array(values.astype(np.float32), name)
