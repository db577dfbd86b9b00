"""Labels from any range-image network in ONNX format, run by onnxruntime. No other module imports onnxruntime.

A YAML file beside the model, with the same name, describes its inputs and outputs.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from segslam.core.errors import brief
from segslam.core.extras import how_to_install
from segslam.core.points import within_range
from segslam.core.types import Label, Labels, Points, SegslamError, Vector
from segslam.labels.network_settings import read_settings, settings_file
from segslam.labels.range_image import Projection, network_input, point_labels

LabelImage = UInt8[np.ndarray, "_ _"]


class Network:
    """A network of an .onnx file that labels scans, with the settings of its `settings_file`."""

    def __init__(self, model: Path) -> None:
        """Open the network, and check it on an empty image.

        Raises SegslamError if a file is missing or invalid, if onnxruntime is not installed, and if model and settings
        contradict each other (with both values).
        """
        if not model.is_file():
            raise SegslamError(f"{model}: no such file; give the model as network:MODEL.onnx")
        self.settings = read_settings(settings_file(model))
        try:
            import onnxruntime
        except ImportError as error:
            raise SegslamError(f"--labels network: needs a package ({error}): {how_to_install('network')}") from error
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3  # errors, which are raised anyway
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads leave cores to others
        try:
            session = onnxruntime.InferenceSession(model, options, providers=onnxruntime.get_available_providers())
            [(each.name, each.type, each.shape) for each in session.get_inputs()]  # fails for names not in UTF-8
        except _runtime_errors() as error:
            raise SegslamError(
                f"{model}: onnxruntime cannot load it ({brief(str(error), 300)}); {_remedy(error)}"
            ) from error
        wanted = (1, len(self.settings.channels), self.settings.height, self.settings.width)
        _check_input(session, model, wanted)
        self._model = model
        self._session = session
        self._input = session.get_inputs()[0].name
        self._label_of_class = np.array([int(label) for label in self.settings.classes], np.uint8)
        self.label_image(np.zeros(wanted, np.float32))

    def labels(self, points: Points, intensities: Vector) -> Labels:
        """The label (n,) of each point (n, 3) of a scan in the LiDAR frame, in the order of its file.

        UNLABELLED for points that are not finite or at the origin. Zeros replace intensities that are not finite.
        Raises SegslamError for class ids beyond the classes of the settings, and for outputs that are not finite.
        """
        labels = np.full(len(points), Label.UNLABELLED, np.uint8)
        usable = within_range(points, 0.0, np.inf)
        if usable.any():
            near = points[usable].astype(np.float64)
            projection = Projection(near, settings=self.settings)
            known = np.where(np.isfinite(intensities), intensities, 0.0)[usable]
            image = network_input(near, known, projection, settings=self.settings)
            labels[usable] = point_labels(self.label_image(image), projection, settings=self.settings.votes)
        return labels

    def label_image(self, image: np.ndarray) -> LabelImage:
        """(height, width) labels for an input (1, channels, height, width) float32."""
        try:
            output = self._session.run(None, {self._input: image})[0]
        except _runtime_errors() as error:
            raise SegslamError(
                f"{self._model}: fails on an input {_shape(image.shape)} ({brief(str(error), 300)})"
            ) from error
        if not isinstance(output, np.ndarray):
            raise SegslamError(f"{self._model}: gives a {type(output).__name__}; export it with one array as output")
        return self._label_of_class[self._class_image(output)]

    def _class_image(self, output: np.ndarray) -> np.ndarray:
        """(height, width) class ids of the first output: ids as given, or the class with the largest logit."""
        size, num = (self.settings.height, self.settings.width), len(self._label_of_class)
        if output.dtype.kind in "iu":
            what, allowed = "class ids", [(1, *size), (1, 1, *size), size]
        else:
            what, allowed = "logits", [(1, num, *size)]
        if output.shape not in allowed:
            expected = " or ".join(_shape(shape) for shape in allowed)
            raise _misfit(self._model, f"gives {what} of {_shape(output.shape)}", f"requires {expected}")
        if what == "logits":
            if not np.isfinite(output).all():
                raise SegslamError(f"{self._model}: returned logits that are not finite; export it again in float32")
            return output[0].argmax(axis=0)
        ids = output.reshape(size)
        if ids.min() < 0 or ids.max() >= num:
            wrong = ids.min() if ids.min() < 0 else ids.max()
            raise _misfit(self._model, f"gave class id {wrong}", f"names {num} classes, ids 0 to {num - 1}")
        return ids


def _runtime_errors() -> tuple[type[Exception], ...]:
    """Exceptions of onnxruntime for models that it cannot use."""
    from onnxruntime.capi import onnxruntime_pybind11_state as state

    own = [kind for kind in vars(state).values() if isinstance(kind, type) and issubclass(kind, Exception)]
    return (*own, RuntimeError, ValueError, LookupError)


def _remedy(error: Exception) -> str:
    """The remedy for a model that cannot be loaded, such as one whose weights are in a separate file."""
    outside = re.search(r'External data path does not exist: "([^"]+)"', str(error))
    if outside is None:
        return "export it again"
    name = Path(outside[1]).name
    return f"its weights are in a separate file, {name}: put it beside the model, or export with external_data=False"


def _check_input(session: Any, model: Path, wanted: tuple[int, ...]) -> None:
    """Raises SegslamError unless the model takes one float32 image of that shape. Open dimensions fit any size."""
    inputs = session.get_inputs()
    if len(inputs) != 1 or inputs[0].type != "tensor(float)":
        found = ", ".join(f"{each.name}: {each.type}" for each in inputs)
        raise SegslamError(
            f"{model}: takes the inputs {found}; expected a single input of type float32, tensor(float); wrap "
            "a network with several inputs as docs/network_labels.md shows"
        )
    shape = inputs[0].shape
    fits = len(shape) == len(wanted) and all(
        not isinstance(size, int) or size == asked for size, asked in zip(shape, wanted, strict=True)
    )
    if not fits:
        raise _misfit(model, f"takes an image of {_shape(shape)}", f"makes one of {_shape(wanted)}")


def _misfit(model: Path, found: str, expected: str) -> SegslamError:
    return SegslamError(f"{model}: {found}, but {settings_file(model).name} {expected}; correct one of them")


def _shape(sizes: Any) -> str:
    return " x ".join(str(size) for size in sizes)
