"""Import of network settings: `arch_cfg.yaml` and `data_cfg.yaml` of lidar-bonnetal (Milioto et al., IROS 2019).

SalsaNext, CENet, SqueezeSegV3, MINet and 3D-MiniNet use the same files. Classes are matched by name, because their
numbers differ between data sets.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, AliasPath, BaseModel, Field

from segslam.core.types import Label, SegslamError

ARCH, DATA = "arch_cfg.yaml", "data_cfg.yaml"
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


def _at(*keys: str, default: Any = ...) -> Any:
    """A field whose value is at this place of the file."""
    return Field(default, validation_alias=AliasPath(*keys))


SENSOR, VOTES = ("dataset", "sensor"), ("post", "KNN")


class VoteParameters(BaseModel):
    """Parameters of the vote, under their names in the file."""

    knn: int
    search: int
    sigma: float
    cutoff: float


class Architecture(BaseModel):
    """The keys of an `arch_cfg.yaml` that are used; the others concern training."""

    projection: Literal["spherical"] = _at(*SENSOR, "type", default="spherical")
    fov_up: float = _at(*SENSOR, "fov_up")
    fov_down: float = _at(*SENSOR, "fov_down")
    fov_left: float = _at(*SENSOR, "fov_left", default=-180.0)
    fov_right: float = _at(*SENSOR, "fov_right", default=180.0)
    width: int = _at(*SENSOR, "img_prop", "width")
    height: int = _at(*SENSOR, "img_prop", "height")
    mean: Channels = _at(*SENSOR, "img_means")
    std: Channels = _at(*SENSOR, "img_stds")
    uses_votes: bool = _at(*VOTES, "use")
    votes: VoteParameters | bool = _at(*VOTES, "params", default=False)

    def settings(self) -> dict[str, Any]:
        """The same as keys of a network's YAML file, without the classes."""
        votes: dict[str, Any] = {"window": 1, "neighbours": 1}  # without a vote, a point has the class of its pixel
        if self.uses_votes and isinstance(self.votes, VoteParameters):
            votes = {
                "window": self.votes.search,
                "neighbours": self.votes.knn,
                "sigma_px": self.votes.sigma,
                "cutoff_m": self.votes.cutoff or 1e6,  # 0 in these files: no limit
            }
        return {
            "field_of_view_deg": (self.fov_down, self.fov_up),
            "azimuth_deg": (self.fov_left, self.fov_right),
            "height": self.height,
            "width": self.width,
            "mean": self.mean,
            "std": self.std,
            "votes": votes,
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


def _label(name: str) -> Label:
    label = LABEL_OF_NAME.get(name.strip().lower().replace(" ", "-").replace("_", "-"))
    if label is None:
        raise SegslamError(
            f"{name} is not a class of SemanticKITTI; write a YAML file beside the model with `import: {ARCH}` and the "
            "label of each output under `classes:`"
        )
    return label
