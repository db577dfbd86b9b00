"""Options common to all commands that make a run."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from segslam.cli.completion import presets
from segslam.cli.console import (
    ConfigOption,
    DatasetOption,
    EncodingOption,
    FramesOption,
    JsonOption,
    LabelsOption,
    QuietOption,
    RefineMinutesOption,
    SequenceOption,
    SetOption,
    with_minutes,
)
from segslam.cli.export import WITH_MAP
from segslam.cli.foxglove import FoxgloveOption
from segslam.cli.overwriting import OverwriteOption
from segslam.core.whole_files import check_target

if TYPE_CHECKING:
    from segslam.core.config import Config
    from segslam.scans import DataSource

DataArgument = Annotated[Path, typer.Argument(help="Folder of scans, recording, or KITTI folder (with sequences/).")]
TopicOption = Annotated[
    str, typer.Option("--topic", help="Point cloud topic, if the recording (rosbag, mcap) has more than one.")
]
OdometryOption = Annotated[
    Path | None,
    typer.Option("--odometry", help="Trajectory to use instead of KISS-ICP (KITTI or TUM format, LiDAR frame)."),
]
PresetOption = Annotated[
    str,
    typer.Option(
        "--preset",
        autocompletion=presets,
        help="Settings for an environment: driving, campus or indoor; auto: by the scans.",
    ),
]
ResumeOption = Annotated[bool, typer.Option("--resume", help="Continue the interrupted run in --out.")]
DryRunOption = Annotated[
    bool, typer.Option("--dry-run", help="Show the content of DATA and the settings; write nothing. Needs no --out.")
]
WithMapOption = Annotated[
    bool, typer.Option("--map", help="Also write the map: map.ply (cloud) and map.png (top view).")
]
MapFileOption = Annotated[
    list[Path] | None,
    typer.Option(
        help="Also write the map to this file in the run folder: .ply .pcd .las .laz .png .yaml; may be repeated."
    ),
]
ViewOption = Annotated[bool, typer.Option("--view", help="Show the run in the Rerun viewer while it is mapped.")]


@dataclass(frozen=True)
class OutputOptions:
    """Settings, and what a run writes and shows beside its results: of `map`, `localise` and `live`."""

    config: ConfigOption = None
    settings: SetOption = None
    refine_minutes: RefineMinutesOption = None
    with_map: WithMapOption = False
    map_file: MapFileOption = None
    view: ViewOption = False
    foxglove: FoxgloveOption = None
    overwrite: OverwriteOption = False
    json: JsonOption = False
    quiet: QuietOption = False

    def load_config(self, *, base: "Config | None" = None) -> "Config":
        """The settings. Raises SegslamError as `segslam.core.config.load_config`."""
        from segslam.core.config import load_config

        return load_config(self.config, with_minutes(self.settings, self.refine_minutes), base=base)

    def maps(self, folder: Path) -> tuple[list[Path], list[Path]]:
        """Map files as given, and as paths in the run folder. Raises SegslamError if one cannot be written."""
        from segslam.output.map import check_names

        names = [*map(Path, WITH_MAP if self.with_map else ()), *(self.map_file or ())]
        files = [folder / name for name in names]
        check_names(files)
        for file in files:
            if folder not in file.parents:
                check_target(file)
        return names, files


@dataclass(frozen=True)
class RunOptions:
    """What is mapped, and how: of `map` and `localise`."""

    dataset: DatasetOption = None
    sequence: SequenceOption = "00"
    frames: FramesOption = None
    topic: TopicOption = ""
    labels: LabelsOption = "auto"
    encoding: EncodingOption = None
    odometry: OdometryOption = None
    preset: PresetOption = "auto"
    resume: ResumeOption = False

    def source(self, data: Path) -> "DataSource":
        """What opens the scans."""
        from segslam.scans import DataSource

        return DataSource(data, self.sequence, self.dataset, self.labels, self.encoding, self.frames, self.topic)
