"""`segslam export`, `convert` and `georeference`: maps and trajectories for other programs; place on the globe."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from segslam.cli.checks import check_exists, check_free, check_links
from segslam.cli.console import Terminal
from segslam.cli.ending import map_summary
from segslam.cli.options import GnssOptions, OverwriteOption, Settings
from segslam.core.errors import SegslamError, counted

FormatOf = Literal["kitti", "tum", "csv"] | None


def export(
    run: Annotated[Path, "Folder of a finished run."],
    files: Annotated[
        list[Path],
        "Files to write: .ply .pcd .las .laz (cloud), .png (top view), .yaml (grid), or before_after.png; of "
        "a georeferenced run also .tif (GeoTIFF), .geojson .kml .gpx (trajectory), map_projector_info.yaml.",
    ],
    *,
    changes: Settings,
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Write the map of a finished run: a point cloud, a top view, an occupancy grid for map_server.

    After `segslam georeference` maps are in the local frame (east, north, up), .las, .laz and .tif in UTM.

    Example: segslam export runs/00 map.laz map.png grid.yaml --set map.color=height
    """
    check_free(files, overwrite=overwrite)
    terminal.announce(f"export: reading {run}")
    from segslam.output.export import write_maps
    from segslam.output.log import read_log

    log = read_log(run)
    figures = write_maps(log, files, config=changes.load(base=log.config).map, show=terminal.progress)
    terminal.answer(figures, map_summary(figures, files))


def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Trajectory: KITTI, TUM or CSV format.")],
    target: Annotated[
        Path, typer.Argument(metavar="OUT", help="File to write; .csv, .tum and .kitti name their format.")
    ],
    *,
    source_format: Annotated[
        FormatOf, typer.Option("--from", help="Format of IN; detected by default from its columns.")
    ] = None,
    target_format: Annotated[
        FormatOf, typer.Option("--to", help="Format of OUT; by default by its name, else TUM if there are stamps.")
    ] = None,
    times: Annotated[Path | None, "KITTI's times.txt: one time (s) a line, for poses without stamps."] = None,
    calib: Annotated[Path | None, "KITTI's calib.txt, for --to-frame."] = None,
    to_frame: Annotated[
        Literal["camera", "lidar"] | None,
        "Write poses of the LiDAR for those of the camera, or the reverse; needs --calib.",
    ] = None,
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Convert a trajectory between KITTI, TUM and CSV, and between the frames of camera and LiDAR.

    Example: segslam convert poses/00.txt 00.tum --times sequences/00/times.txt
    """
    check_exists(source, "give a trajectory")
    check_free([target], overwrite=overwrite)
    terminal.announce(f"convert: reading {source}")
    from segslam.output.conversion import convert as convert_file

    num_poses = convert_file(
        source, target, source_format=source_format, target_format=target_format, times=times, calib=calib, to=to_frame
    )
    terminal.answer({"num_poses": num_poses, "file": str(target)}, f"{counted(num_poses, 'pose')} in {target}")


def georeference(run: Annotated[Path, "Folder of a finished run."], *, gnss: GnssOptions, terminal: Terminal) -> None:
    """Place a finished run on the globe by its position fixes, right also where the receiver is wrong.

    Writes georeference.json, gnss.csv (each fix: kept, or why not), poses_geodetic.csv and poses_enu_tum.txt into its
    folder. `segslam export` then writes maps with a coordinate system.

    Example: segslam georeference runs/00 --gnss fixes.csv
    """
    check_exists(run, "give the folder of a finished run")
    terminal.announce(f"georeference: reading {run}")
    from segslam.output.folder import PLACE_FILES, PLACE_ON_GLOBE, folder_of
    from segslam.output.log import read_log
    from segslam.output.report import write_report

    folder = folder_of(run)
    check_links(folder)
    data = read_log(folder).options.get("data")  # may have a topic with fixes
    place = gnss.placing(Path(data) if data else None)
    if place is None:
        raise SegslamError("--gnss: give the position fixes, as in --gnss fixes.csv")
    placed = place(folder)
    write_report(folder)
    if terminal.json:
        print((folder / PLACE_ON_GLOBE).read_text(encoding="utf-8").rstrip(), flush=True)
    else:
        terminal.say(f"{placed}\nresults in {folder}: {', '.join(PLACE_FILES)}")
