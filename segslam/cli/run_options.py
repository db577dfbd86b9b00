"""Options common to all commands that make a run."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.export import WITH_MAP
from segslam.system.whole_files import check_target

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
    typer.Option("--preset", help="Settings for an environment: driving, campus or indoor; auto: by DATA."),
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


def chosen_maps(folder: Path, *, with_map: bool, map_file: Sequence[Path] | None) -> tuple[list[Path], list[Path]]:
    """Map files as given, and as paths in the run folder. Raises SegslamError for a file that cannot be written."""
    from segslam.map import check_names

    names = [*map(Path, WITH_MAP if with_map else ()), *(map_file or ())]
    files = [folder / name for name in names]
    check_names(files)
    for file in files:
        if folder not in file.parents:
            check_target(file)
    return names, files
