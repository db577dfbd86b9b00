"""`segslam localise`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import (
    ConfigOption,
    DatasetOption,
    EncodingOption,
    FramesOption,
    JsonOption,
    LabelsOption,
    QuietOption,
    SequenceOption,
    SetOption,
)
from segslam.cli.map import map_command
from segslam.cli.run_options import (
    DataArgument,
    MapFileOption,
    OdometryOption,
    PresetOption,
    ResumeOption,
    TopicOption,
    ViewOption,
    WithMapOption,
)


def localise(
    run: Annotated[Path, typer.Argument(help="Folder of the finished run that provides the map. It is not changed.")],
    data: DataArgument,
    out: Annotated[Path, typer.Option(help="New folder for the run; with --resume the folder of the run.")],
    dataset: DatasetOption = None,
    sequence: SequenceOption = "00",
    frames: FramesOption = None,
    topic: TopicOption = "",
    labels: LabelsOption = "auto",
    encoding: EncodingOption = None,
    odometry: OdometryOption = None,
    config: ConfigOption = None,
    settings: SetOption = None,
    preset: PresetOption = "auto",
    with_map: WithMapOption = False,
    map_file: MapFileOption = None,
    view: ViewOption = False,
    resume: ResumeOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Localise new scans in the map of an earlier run; writes a run folder like `map`, in the frame of the earlier run.

    The first pose is found without initial guess, and likewise after tracking is lost. Scans far from every pose found
    in the map are marked in localised.csv and omitted from poses_tum.txt. Example: segslam localise runs/monday
    friday_scans --out runs/friday
    """
    check_exists(run, "give the folder of a finished run")
    map_command(
        data,
        out,
        dataset=dataset,
        sequence=sequence,
        frames=frames,
        topic=topic,
        labels=labels,
        encoding=encoding,
        odometry=odometry,
        config=config,
        settings=settings,
        preset=preset,
        with_map=with_map,
        map_file=map_file,
        view=view,
        resume=resume,
        in_map=run,
        json=json,
        quiet=quiet,
    )
