"""`segslam convert`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import JsonOption, QuietOption, announce, print_json, say
from segslam.cli.overwriting import OverwriteOption, check_free

FormatOf = Literal["kitti", "tum", "csv"] | None


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Trajectory: KITTI, TUM or CSV format.")],
    target: Annotated[
        Path, typer.Argument(metavar="OUT", help="File to write; .csv, .tum and .kitti name their format.")
    ],
    source_format: Annotated[
        FormatOf, typer.Option("--from", help="Format of IN; detected by default from its columns.")
    ] = None,
    target_format: Annotated[
        FormatOf, typer.Option("--to", help="Format of OUT; by default by its name, else TUM if there are stamps.")
    ] = None,
    times: Annotated[
        Path | None, typer.Option(help="KITTI's times.txt: one time (s) a line, for poses without stamps.")
    ] = None,
    calib: Annotated[Path | None, typer.Option(help="KITTI's calib.txt, for --to-frame.")] = None,
    to_frame: Annotated[
        Literal["camera", "lidar"] | None,
        typer.Option(help="Write poses of the LiDAR for those of the camera, or the reverse; needs --calib."),
    ] = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Convert a trajectory between KITTI, TUM and CSV, and between the frames of camera and LiDAR.

    Example: segslam convert poses/00.txt 00.tum --times sequences/00/times.txt
    """
    check_exists(source, "give a trajectory")
    check_free([target], overwrite=overwrite)
    announce(f"convert: reading {source}", quiet=quiet)
    from segslam.output.conversion import convert as convert_file

    num_poses = convert_file(
        source,
        target,
        source_format=source_format,
        target_format=target_format,
        times=times,
        calib=calib,
        to=to_frame,
    )
    if json:
        print_json({"num_poses": num_poses, "file": str(target)})
    else:
        say(f"{num_poses} poses in {target}", quiet=quiet)
