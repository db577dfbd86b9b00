"""Import of network settings: `arch_cfg.yaml` and `data_cfg.yaml` of lidar-bonnetal (Milioto et al., IROS 2019).

SalsaNext, CENet, SqueezeSegV3, MINet and 3D-MiniNet use the same files. Classes are matched by name, because their
numbers differ between data sets.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel

from segslam.core.types import Label, SegslamError

ARCH, DATA = "arch_cfg.yaml", "data_cfg.yaml"
NO_CUTOFF_M = 1e6
"""Stored as 0 in these files."""
MERGED = {
    "unlabeled": Label.UNLABELLED,
    "outlier": Label.UNLABELLED,
    "other-structure": Label.UNLABELLED,
    "other-object": Label.UNLABELLED,
    "bus": Label.OTHER_VEHICLE,
    "on-rails": Label.OTHER_VEHICLE,
    "lane-marking": Label.ROAD,
    "moving-bus": Label.MOVING_OTHER_VEHICLE,
    "moving-on-rails": Label.MOVING_OTHER_VEHICLE,
}
"""Classes of SemanticKITTI that its benchmark merges into other classes."""
LABEL_OF_NAME = {label.name.lower().replace("_", "-"): label for label in Label} | MERGED


def _check_channels(values: tuple[float, ...]) -> tuple[float, ...]:
    if len(values) != 5:
        raise ValueError(
            f"{len(values)} numbers; expected 5, for range, x, y, z and signal: networks that need surface normals "
            "are not supported"
        )
    return values


Channels = Annotated[tuple[float, ...], AfterValidator(_check_channels)]


class _Size(BaseModel):
    width: int
    height: int


class _Sensor(BaseModel):
    type: Literal["spherical"] = "spherical"
    fov_up: float
    fov_down: float
    fov_left: float = -180.0
    fov_right: float = 180.0
    img_prop: _Size
    img_means: Channels
    img_stds: Channels


class _Dataset(BaseModel):
    sensor: _Sensor


class _VoteParameters(BaseModel):
    knn: int
    search: int
    sigma: float
    cutoff: float


class _Votes(BaseModel):
    use: bool
    params: _VoteParameters | bool = False


class _Post(BaseModel):
    KNN: _Votes


class Architecture(BaseModel):
    """The keys of an `arch_cfg.yaml` that are used; the others concern training."""

    dataset: _Dataset
    post: _Post

    def settings(self) -> dict[str, Any]:
        """The same as keys of a network's YAML file, without the classes."""
        sensor = self.dataset.sensor
        return {
            "field_of_view_deg": (sensor.fov_down, sensor.fov_up),
            "azimuth_deg": (sensor.fov_left, sensor.fov_right),
            "height": sensor.img_prop.height,
            "width": sensor.img_prop.width,
            "mean": sensor.img_means,
            "std": sensor.img_stds,
            "votes": self._votes(),
        }

    def _votes(self) -> dict[str, Any]:
        """The settings of the vote; without a vote, a point has the class of its pixel."""
        parameters = self.post.KNN.params
        if not self.post.KNN.use or isinstance(parameters, bool):
            return {"window": 1, "neighbours": 1}
        return {
            "window": parameters.search,
            "neighbours": parameters.knn,
            "sigma_px": parameters.sigma,
            "cutoff_m": parameters.cutoff or NO_CUTOFF_M,
        }


class ClassMap(BaseModel):
    """The keys of a `data_cfg.yaml` that are used: the raw id of each output, and the name of each raw id."""

    labels: dict[int, str]
    learning_map_inv: dict[int, int]

    def classes(self) -> list[Label]:
        """The label of each output, in order.

        Raises SegslamError if an output has no raw id, a raw id no name, or SemanticKITTI no class of that name.
        """
        outputs = range(len(self.learning_map_inv))
        missing = [output for output in outputs if self.learning_map_inv.get(output) not in self.labels]
        if missing:
            raise SegslamError(f"output {missing[0]} has no entry in learning_map_inv, or its id has no name in labels")
        return [_label(self.labels[self.learning_map_inv[output]]) for output in outputs]


def is_architecture(values: Any) -> bool:
    """True if the content of a YAML file is that of an `arch_cfg.yaml`."""
    return isinstance(values, dict) and isinstance(values.get("dataset"), dict) and "sensor" in values["dataset"]


def class_map_file(architecture: Path) -> Path:
    """The file with the classes of a network."""
    return architecture.with_name(DATA)


def _label(name: str) -> Label:
    label = LABEL_OF_NAME.get(name.strip().lower().replace(" ", "-").replace("_", "-"))
    if label is None:
        raise SegslamError(
            f"{name} is not a class of SemanticKITTI; write a YAML file beside the model with `import: {ARCH}` and the "
            "label of each output under `classes:`"
        )
    return label
