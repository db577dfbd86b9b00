"""`segslam georeference`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import JsonOption, QuietOption, announce, print_out, say
from segslam.cli.gnss_options import GnssOffsetOption, GnssOption, GnssOptions, GnssUseOption
from segslam.core.errors import SegslamError


def georeference(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    gnss: GnssOption = None,
    gnss_use: GnssUseOption = "fuse",
    gnss_offset: GnssOffsetOption = 0.0,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Place a finished run on the globe by its position fixes, right also where the receiver is wrong.

    Writes georeference.json, gnss.csv (each fix: kept, or why not), poses_geodetic.csv and poses_enu_tum.txt into its
    folder. `segslam export` then writes maps with a coordinate system.

    Example: segslam georeference runs/00 --gnss fixes.csv
    """
    check_exists(run, "give the folder of a finished run")
    announce(f"georeference: reading {gnss}", quiet=quiet)
    from segslam.output.folder import folder_of
    from segslam.output.georeferenced import FILE
    from segslam.output.report import write_report

    folder = folder_of(run)
    place = GnssOptions(gnss, gnss_use, gnss_offset).placing(_recording_of(folder))
    if place is None:
        raise SegslamError("--gnss: give the position fixes, as in --gnss fixes.csv")
    placed = place(folder)
    write_report(folder)
    if json:
        print_out((folder / FILE).read_text(encoding="utf-8").rstrip())
    else:
        say(f"{placed}\nresults in {folder}: georeference.json, gnss.csv, poses_geodetic.csv", quiet=quiet)


def _recording_of(folder: Path) -> Path | None:
    """The data that a run was made from, which may have a topic with fixes."""
    from segslam.output.folder import log_of
    from segslam.output.log import read_log

    data = read_log(log_of(folder)).options.get("data")
    return Path(data) if data else None
