"""What a network expects of its input and means by its output: the YAML file beside the model."""

from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import AfterValidator, Field, ValidationError, model_validator

from segslam.config import LabelName, Section
from segslam.types import SegslamError

Channel = Literal["range", "x", "y", "z", "intensity"]


def _check_odd(value: int) -> int:
    if value % 2 == 0:
        raise ValueError("a window has a middle: write an odd number")
    return value


class VoteSettings(Section):
    """The vote of neighbouring pixels on the class of a point; defaults as in RangeNet++ (Milioto et al. 2019)."""

    window: Annotated[int, AfterValidator(_check_odd)] = Field(5, ge=1, le=15, description="pixels along a side")
    neighbours: int = Field(5, ge=1, description="pixels that vote: those nearest in range")
    sigma_px: float = Field(1.0, gt=0, description="of the Gaussian that favours pixels near by in the image (pixels)")
    cutoff_m: float = Field(1.0, gt=0, description="a pixel farther off in range, so weighted, has no vote (m)")


class NetworkSettings(Section):
    """Of one model. The image's columns go clockwise from behind the sensor, its rows from the highest beam down."""

    field_of_view_deg: tuple[float, float] = Field(description="elevation of the lowest and highest row (degrees)")
    height: int = Field(ge=1, description="rows of the image: beams")
    width: int = Field(ge=1, description="columns of the image: the full circle")
    channels: tuple[Channel, ...] = Field(
        ("range", "x", "y", "z", "intensity"), min_length=1, description="in the order of the input"
    )
    mean: tuple[float, ...] = Field(description="of each channel, subtracted")
    std: tuple[Annotated[float, Field(gt=0)], ...] = Field(description="of each channel, divided by")
    classes: tuple[LabelName, ...] = Field(
        min_length=2, description="label of each output class, by name or learning id, in the order of the output"
    )
    votes: VoteSettings = VoteSettings()

    @model_validator(mode="after")
    def _fits_together(self) -> "NetworkSettings":
        low, high = self.field_of_view_deg
        if not -90 <= low < high <= 90:
            raise ValueError(f"field_of_view_deg: write the lowest elevation, then the highest, not {low}, {high}")
        for name in ("mean", "std"):
            count = len(getattr(self, name))
            if count != len(self.channels):
                raise ValueError(f"{name}: {count} numbers for {len(self.channels)} channels")
        return self


def read_settings(file: Path) -> NetworkSettings:
    """The settings of a YAML file. Raises SegslamError that names file and key for whatever is wrong with it."""
    try:
        values = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise SegslamError(f"{file}: cannot be read ({error}); a network needs this file beside its model") from error
    except yaml.YAMLError as error:
        raise SegslamError(f"{file}: no valid YAML ({' '.join(str(error).split())})") from error
    try:
        return NetworkSettings.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        known = f"; known: {', '.join(NetworkSettings.model_fields)}" if first["type"] == "extra_forbidden" else ""
        raise SegslamError(f"{file}: {key + ': ' if key else ''}{first['msg']}{known}") from error
