"""Settings of a network: format of its input and meaning of its output, from the YAML file beside the model.

They may be imported from the `arch_cfg.yaml` and `data_cfg.yaml` of lidar-bonnetal (Milioto et al., IROS 2019), which
SalsaNext, CENet, SqueezeSegV3, MINet and 3D-MiniNet use, too. Classes are matched by name, because their numbers differ
between data sets.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, AliasPath, BaseModel, Field, model_validator

from segslam.core.config import LabelName, Section, parse_yaml, validated
from segslam.core.errors import brief
from segslam.core.types import Label, SegslamError
from segslam.core.whole_files import read_text

ARCH, DATA = "arch_cfg.yaml", "data_cfg.yaml"
Channel = Literal["range", "x", "y", "z", "intensity", "mask"]


def _check_odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError("the side of a window must be an odd number")
    return value


class VoteSettings(Section):
    """Voting of neighbouring pixels on the class of a point; defaults of RangeNet++ (Milioto et al. 2019)."""

    window: Annotated[int, AfterValidator(_check_odd)] = Field(5, ge=1, le=15, description="window side (pixels)")
    neighbours: int = Field(5, ge=1, le=225, description="number of voting pixels, the nearest ones in range")
    sigma_px: float = Field(1.0, gt=0, description="sigma of the Gaussian weight by distance in the image (pixels)")
    cutoff_m: float = Field(1.0, gt=0, description="largest weighted range difference of a voting pixel (m)")


class ImageSettings(Section):
    """Size of a range image. Columns go clockwise, starting behind the sensor; rows go from top to bottom."""

    field_of_view_deg: tuple[float, float] = Field(description="elevation of the lowest and highest row (degrees)")
    height: int = Field(ge=1, le=1024, description="rows of the image, one per beam")
    width: int = Field(ge=1, le=16384, description="columns of the image, for the full circle")


class NetworkSettings(ImageSettings):
    """Settings of one model: its input image and the meaning of its outputs."""

    azimuth_deg: tuple[float, float] = Field(
        (-180.0, 180.0), description="azimuth of the left and right edge (degrees); must be the full circle"
    )
    channels: tuple[Channel, ...] = Field(
        ("range", "x", "y", "z", "intensity"),
        min_length=1,
        description="input channels in order; mask is 1 for pixels with a point",
    )
    mean: tuple[float, ...] = Field(description="value subtracted from each channel")
    std: tuple[Annotated[float, Field(gt=0)], ...] = Field(description="value by which each channel is divided")
    classes: tuple[LabelName, ...] = Field(
        min_length=2, description="label of each output class, by name or learning id, in the order of the outputs"
    )
    votes: VoteSettings = VoteSettings()

    @model_validator(mode="after")
    def _fits_together(self) -> "NetworkSettings":
        low, high = self.field_of_view_deg
        if not -90 <= low < high <= 90:
            raise ValueError(f"field_of_view_deg: give the lowest elevation, then the highest, not {low}, {high}")
        if sorted(self.azimuth_deg) != [-180, 180]:
            left, right = self.azimuth_deg
            raise ValueError(
                f"azimuth_deg: {left:g} to {right:g}; the image must show the full circle, -180 to 180: loop closing "
                "needs labels in all directions"
            )
        for name in ("mean", "std"):
            count = len(getattr(self, name))
            if count != len(self.channels):
                raise ValueError(f"{name}: {count} numbers for {len(self.channels)} channels")
        return self


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
        return self.model_dump(include={"height", "width", "mean", "std"}) | {
            "field_of_view_deg": (self.fov_down, self.fov_up),
            "azimuth_deg": (self.fov_left, self.fov_right),
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
        classes = []
        for output in range(len(self.learning_map_inv)):
            name = self.labels.get(self.learning_map_inv[output]) if output in self.learning_map_inv else None
            if name is None:
                raise SegslamError(f"output {output} has no entry in learning_map_inv, or its id has no name in labels")
            label = LABEL_OF_NAME.get(name.strip().lower().replace(" ", "-").replace("_", "-"))
            if label is None:
                raise SegslamError(
                    f"{name} is not a class of SemanticKITTI; write a YAML file beside the model with `import: {ARCH}` "
                    "and the label of each output under `classes:`"
                )
            classes.append(label)
        return classes


def settings_file(model: Path) -> Path:
    """The YAML file of a model; if there is none, the `arch_cfg.yaml` in the folder of the model."""
    own, published = model.with_suffix(".yaml"), model.with_name(ARCH)
    return published if published.is_file() and not own.exists() else own


def read_settings(file: Path) -> NetworkSettings:
    """The settings from a model's YAML file, or from the files published with it.

    `import: arch_cfg.yaml` reads that file and the `data_cfg.yaml` beside it; other keys override their values.
    Raises SegslamError, naming file and key, for invalid settings.
    """
    values = _read_yaml(file)
    if isinstance(values, dict) and isinstance(values.get("dataset"), dict) and "sensor" in values["dataset"]:
        return validated(NetworkSettings, _imported(file, {}), str(file))
    if isinstance(values, dict) and isinstance(values.get("import"), str):
        source = file.parent / values.pop("import")
        try:
            values = _imported(source, values) | values
        except SegslamError as error:
            raise SegslamError(f"{file}: import: {brief(str(error), 300)}") from error
    return validated(NetworkSettings, values, str(file))


def _imported(architecture: Path, given: dict[str, Any]) -> dict[str, Any]:
    """The settings in an `arch_cfg.yaml`, and in the `data_cfg.yaml` beside it unless `classes` are given."""
    settings = validated(Architecture, _read_yaml(architecture), str(architecture)).settings()
    if "classes" in given:
        return settings
    file = architecture.with_name(DATA)
    if not file.is_file():
        raise SegslamError(
            f"{file}: no such file; {architecture.name} does not contain the classes: copy the network's "
            "config/labels/semantic-kitti.yaml there"
        )
    class_map = validated(ClassMap, _read_yaml(file), str(file))
    try:
        return settings | {"classes": class_map.classes()}
    except SegslamError as error:
        raise SegslamError(f"{file}: {error}") from error


def _read_yaml(file: Path) -> Any:
    remedy = f"a network needs this file beside its model, or the {ARCH} and {DATA} that were published with it"
    return parse_yaml(read_text(file, "settings", remedy), str(file))
