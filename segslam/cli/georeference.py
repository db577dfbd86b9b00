"""`segslam georeference`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import JsonOption, QuietOption, announce, print_json, say

if TYPE_CHECKING:
    from segslam.gnss import Georeference

USES = ("fuse", "align")


def georeference(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    gnss: Annotated[str, typer.Option(help="Position fixes: CSV, NMEA, RTKLIB .pos, a KITTI oxts folder.")],
    gnss_use: Annotated[
        str, typer.Option(help="fuse: bend the map where held-out fixes confirm it; align: only place it.")
    ] = "fuse",
    gnss_offset: Annotated[float, typer.Option(help="Seconds to add to the times of the fixes.")] = 0.0,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Place a finished run on the globe by its position fixes, right also where the receiver is wrong.

    Writes georeference.json, gnss.csv (each fix: kept or why not), poses_geodetic.csv and poses_enu_tum.txt.

    Example: segslam georeference runs/00 --gnss fixes.csv
    """
    from segslam.errors import SegslamError

    check_exists(run, "give the folder of a finished run")
    if gnss_use not in USES:
        raise SegslamError(f"--gnss-use {gnss_use}: unknown; known: {', '.join(USES)}")
    announce(f"georeference: reading {run}", quiet=quiet)
    from segslam.run.folder import folder_of
    from segslam.run.georeferenced import figures
    from segslam.run.georeferenced import georeference as georeference_run

    placed = georeference_run(folder_of(run), gnss, use=gnss_use, offset_s=gnss_offset)
    if json:
        print_json(figures(placed))
    else:
        say(summary(placed, folder_of(run)), quiet=quiet)


def summary(placed: "Georeference", folder: Path) -> str:
    """What the fixes say, and what they were used for."""
    east, north, _ = placed.position_sigma_m
    lines = [
        f"{placed.num_kept} of {len(placed.fixes)} fixes kept; single fixes are off by {placed.fix_sigma_m[0]:.2f} m, "
        "a standard deviation",
        f"map placed: heading known to {placed.heading_sigma_deg:.2f} degrees, position to {east:.2f} m east and "
        f"{north:.2f} m north",
    ]
    axes = [name for name, is_bent in zip(("horizontally", "in height"), placed.is_bent, strict=True) if is_bent]
    lines.append(f"trajectory bent {' and '.join(axes)} by the fixes" if axes else "trajectory kept its shape")
    if placed.measured_offset_s:
        lines.append(
            f"clock of the receiver: {placed.measured_offset_s:+.3f} s added to its times, "
            f"known to {placed.offset_sigma_s:.3f} s"
        )
    if placed.arm_m.any():
        lines.append(
            f"antenna {placed.arm_m[0]:+.2f} m ahead and {placed.arm_m[1]:+.2f} m to the left of the LiDAR, "
            f"known to {max(placed.arm_sigma_m):.2f} m"
        )
    if placed.fixes.note:
        lines.append(placed.fixes.note)
    return "\n".join([*lines, f"results in {folder}: georeference.json, gnss.csv, poses_geodetic.csv"])
