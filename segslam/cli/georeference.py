"""`segslam georeference`: places a run on the globe."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import Terminal, print_out
from segslam.cli.options import GnssOptions
from segslam.core.errors import SegslamError


def georeference(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")], *, gnss: GnssOptions, terminal: Terminal
) -> None:
    """Place a finished run on the globe by its position fixes, right also where the receiver is wrong.

    Writes georeference.json, gnss.csv (each fix: kept, or why not), poses_geodetic.csv and poses_enu_tum.txt into its
    folder. `segslam export` then writes maps with a coordinate system.

    Example: segslam georeference runs/00 --gnss fixes.csv
    """
    check_exists(run, "give the folder of a finished run")
    terminal.announce(f"georeference: reading {gnss.gnss}")
    from segslam.output.folder import folder_of
    from segslam.output.georeferenced import FILE
    from segslam.output.log import read_log
    from segslam.output.report import write_report

    folder = folder_of(run)
    data = read_log(folder).options.get("data")  # may have a topic with fixes
    place = gnss.placing(Path(data) if data else None)
    if place is None:
        raise SegslamError("--gnss: give the position fixes, as in --gnss fixes.csv")
    placed = place(folder)
    write_report(folder)
    if terminal.json:
        print_out((folder / FILE).read_text(encoding="utf-8").rstrip())
    else:
        terminal.say(f"{placed}\nresults in {folder}: georeference.json, gnss.csv, poses_geodetic.csv")
