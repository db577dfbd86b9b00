"""`segslam export`, and the map files of other commands."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.console import ConfigOption, JsonOption, QuietOption, SetOption, announce, print_json, progress, say
from segslam.cli.overwriting import OverwriteOption, check_free

if TYPE_CHECKING:
    from segslam.config import MapConfig
    from segslam.log import RunLog
    from segslam.run.georeferenced import Globe
    from segslam.types import Indices, Keyframe, Transform

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
    from segslam.config import load_config
    from segslam.log import read_log
    from segslam.run.folder import log_of

    log = read_log(log_of(run))
    figures = write_maps(log, files, config=load_config(config, settings or (), base=log.config).map, quiet=quiet)
    if json:
        print_json(figures)
    else:
        say(map_summary(figures, files), quiet=quiet)


def write_maps(log: "RunLog", files: Sequence[Path], *, config: "MapConfig", quiet: bool) -> dict[str, Any]:
    """Write the map of a finished run to each of the files, or to none. Returns figures of the map.

    Raises SegslamError if the run did not finish or a name has an unknown extension, WorkFailed if the disk is full.
    """
    from time import perf_counter

    from segslam.map import check_files, write_map
    from segslam.run.georeferenced import read_globe
    from segslam.run.report import BEFORE_AFTER, draw_before_after
    from segslam.run.tracks import is_track, track
    from segslam.system.whole_files import cannot_write, whole_file

    started = perf_counter()
    folder = log.path.parent
    globe = read_globe(folder)
    origin = None if globe is None else globe.origin
    of_map = [file for file in files if file.name != BEFORE_AFTER and not is_track(file)]
    check_files(of_map, origin=origin)
    with ExitStack() as complete:  # moves each file to its name at the end, after a failure none
        for file in files:
            if file.name == BEFORE_AFTER:
                complete.enter_context(whole_file(file)).write_bytes(draw_before_after(folder))
            elif is_track(file):
                content = track(file, globe, _stamps(log), name=folder.resolve().name)
                complete.enter_context(whole_file(file)).write_bytes(content)
        if not of_map:
            return {"map_seconds": perf_counter() - started}
        try:
            placed = _placed(log, globe, quiet=quiet)
            made = write_map(placed, of_map, config=config, origin=origin, show=partial(_shown, quiet=quiet))
        except OSError as error:
            raise cannot_write(of_map[0], error) from error
    return {
        "num_map_points": made.num_points,
        "num_map_moving_points": made.num_moving_points,
        "num_map_voxels_seen_through": made.num_voxels_seen_through,
        "map_seconds": perf_counter() - started,
    }


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


def _stamps(log: "RunLog") -> "Indices":
    """(n,) times of the scans of a finished run (ns)."""
    from segslam.types import SegslamError

    result = log.result()
    if result is None:
        raise SegslamError(f"{log.path}: the run did not finish; replay it, or resume it")
    return result[1].stamp_ns


def _placed(log: "RunLog", globe: "Globe | None", *, quiet: bool) -> "Iterator[tuple[Keyframe, Transform]]":
    """Each keyframe, its points corrected as in the adjustment of the run, with its final T_world_keyframe.

    The world of a georeferenced run is its local frame.
    """
    from dataclasses import replace

    from segslam.geometry import raise_beams
    from segslam.types import SegslamError

    result = log.result()
    if result is None:
        raise SegslamError(
            f"{log.path}: the run did not finish; run `segslam replay` on its log, or resume it with --resume"
        )
    estimate, _ = result
    adjustment = log.adjustment()
    raised_deg = 0.0 if adjustment is None else adjustment.correction_deg
    num_gathered = 0
    for row, step in enumerate(progress(log.steps(), total=log.num_steps(), title="gather", quiet=quiet)):
        if step.keyframe is not None:
            num_gathered += 1
            points = raise_beams(step.keyframe.points, raised_deg)
            T_world_keyframe = estimate.T_world_keyframe[step.keyframe.id] if globe is None else globe.T_enu_lidar[row]
            yield replace(step.keyframe, points=points), T_world_keyframe
    if num_gathered < len(estimate.T_world_keyframe):
        readable = f"only {num_gathered} of its {len(estimate.T_world_keyframe)} keyframes are readable"
        raise SegslamError(f"{log.path}: damaged, {readable}; the map is not written. Map the data again, or replay it")


def _shown(parts: "Iterator[Any]", total: int, *, quiet: bool) -> "Iterator[Any]":
    return progress(parts, total=total, title="clean", quiet=quiet)
