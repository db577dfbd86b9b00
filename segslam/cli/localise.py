"""`segslam localise`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.checks import check_exists
from segslam.cli.map import map_data
from segslam.cli.run_options import DataArgument, OutputOptions, RunOptions
from segslam.cli.shared_options import with_options


@with_options
def localise(
    run: Annotated[Path, typer.Argument(help="Folder of the finished run that provides the map. It is not changed.")],
    data: DataArgument,
    out: Annotated[Path, typer.Option(help="New folder for the run; with --resume the folder of the run.")],
    options: RunOptions,
    output: OutputOptions,
) -> None:
    """Localise new scans in the map of an earlier run; writes a run folder like `map`, in the frame of the earlier run.

    The first pose is found without initial guess, and likewise after tracking is lost. Scans far from every pose found
    in the map are marked in localised.csv and omitted from poses_tum.txt. Example: segslam localise runs/monday
    friday_scans --out runs/friday
    """
    check_exists(run, "give the folder of a finished run")
    map_data(data, out, options, output, in_map=run)
