"""Settings of a network: format of its input and meaning of its output, from the YAML file beside the model."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, model_validator

from segslam.core.config import LabelName, Section, parse_yaml, validated
from segslam.core.errors import brief, unreadable
from segslam.core.types import SegslamError
from segslam.labels.network_import import ARCH, DATA, Architecture, ClassMap, is_architecture

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
    if is_architecture(values):
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
    try:
        return parse_yaml(file.read_text(encoding="utf-8"), str(file))
    except (OSError, UnicodeDecodeError) as error:
        raise SegslamError(
            f"{unreadable(file, 'settings', error)}; a network needs this file beside its model, or the {ARCH} and "
            f"{DATA} that were published with it"
        ) from error
