"""`segslam export`, and the map files of other commands."""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.console import ConfigOption, JsonOption, QuietOption, SetOption, announce, print_json, progress, say
from segslam.cli.overwriting import OverwriteOption, check_free

if TYPE_CHECKING:
    from segslam.core.config import MapConfig
    from segslam.output.log import RunLog

WITH_MAP = ("map.ply", "map.png")
"""Files that `--map` writes into the run folder."""


def export(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")],
    files: Annotated[
        list[Path],
        typer.Argument(
            help="Files to write: .ply .pcd .las .laz (cloud), .png (top view), .yaml (grid), or before_after.png; of "
            "a georeferenced run also .tif (GeoTIFF), .geojson .kml .gpx (trajectory), map_projector_info.yaml."
        ),
    ],
    config: ConfigOption = None,
    settings: SetOption = None,
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Write the map of a finished run: a point cloud, a top view, an occupancy grid for map_server.

    After `segslam georeference` maps are in the local frame (east, north, up), .las, .laz and .tif in UTM.

    Example: segslam export runs/00 map.laz map.png grid.yaml --set map.color=height
    """
    check_free(files, overwrite=overwrite)
    announce(f"export: reading {run}", quiet=quiet)
    from segslam.core.config import load_config
    from segslam.output.folder import log_of
    from segslam.output.log import read_log

    log = read_log(log_of(run))
    figures = write_maps(log, files, config=load_config(config, settings or (), base=log.config).map, quiet=quiet)
    if json:
        print_json(figures)
    else:
        say(map_summary(figures, files), quiet=quiet)


def write_maps(log: "RunLog", files: Sequence[Path], *, config: "MapConfig", quiet: bool) -> dict[str, Any]:
    """As `segslam.output.export.write_maps`, with progress bars."""
    from segslam.output.export import write_maps as write

    return write(log, files, config=config, show=partial(_shown, quiet=quiet))


def map_summary(figures: dict[str, Any], files: Sequence[Path]) -> str:
    """Summary of the map."""
    written = f"map in {', '.join(str(file) for file in files)}"
    if "num_map_points" not in figures:
        return written
    removed = figures["num_map_moving_points"], figures["num_map_voxels_seen_through"]
    return (
        f"map of {figures['num_map_points']} points in {figures['map_seconds']:.1f} s; removed as moving: "
        f"{removed[0]} points by class, {removed[1]} voxels that other scans see through\n"
        f"{written}"
    )


def _shown(items: "Iterable[Any]", total: int, title: str, *, quiet: bool) -> "Iterator[Any]":
    return progress(items, total=total, title=title, quiet=quiet)
