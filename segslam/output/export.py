"""The map of a finished run, written to files."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from segslam.core.config import MapConfig, load_config
from segslam.core.geometry import raise_beams
from segslam.core.types import GraphEstimate, Keyframe, SegslamError, Trajectory, Transform
from segslam.core.whole_files import cannot_write, whole_file
from segslam.output.folder import PLACE_ON_GLOBE
from segslam.output.log import RunLog, read_log
from segslam.output.map.write import check_files, write_map
from segslam.output.tracks import is_track, track
from segslam.slam.adjustment import Progress, no_progress

if TYPE_CHECKING:
    from segslam.output.georeferenced import Globe


def export(run: str | Path, files: Sequence[str | Path], *, settings: Sequence[str] = ()) -> dict[str, Any]:
    """Write the map of a finished run, like `segslam export`; existing files are replaced. Returns figures of the map.

    `files`: .ply .pcd .las .laz (cloud), .png (top view), .yaml (grid) or before_after.png, and of a georeferenced run
    .tif, .geojson, .kml, .gpx and map_projector_info.yaml; all are written, or none.
    `settings`: changes such as `"map.color=height"`. Raises SegslamError, naming the file and the remedy.
    """
    log = read_log(Path(run))
    config = load_config(None, settings, base=log.config).map
    return write_maps(log, [Path(file) for file in files], config=config)


def write_maps(
    log: RunLog, files: Sequence[Path], *, config: MapConfig, show: Progress = no_progress
) -> dict[str, Any]:
    """Write the map of a finished run to each of the files, or to none. Returns figures of the map.

    `show` passes items on, and shows their number and a title.

    Raises SegslamError if the run did not finish or a name has an unknown extension, WorkFailed if the disk is full.
    """
    from segslam.output.report import BEFORE_AFTER, draw_before_after

    started = perf_counter()
    folder = log.path.parent
    globe = None
    if (folder / PLACE_ON_GLOBE).exists():
        from segslam.output.georeferenced import read_globe

        globe = read_globe(folder)
    origin = None if globe is None else globe.origin
    of_map = [file for file in files if file.name != BEFORE_AFTER and not is_track(file)]
    check_files(of_map, origin=origin)
    with ExitStack() as complete:  # moves each file to its name at the end, after a failure none
        for file in files:
            if file.name == BEFORE_AFTER:
                complete.enter_context(whole_file(file)).write_bytes(draw_before_after(folder))
            elif is_track(file):
                content = track(file, globe, _finished(log)[1].stamp_ns, name=folder.resolve().name)
                complete.enter_context(whole_file(file)).write_bytes(content)
        if not of_map:
            return {"map_seconds": perf_counter() - started}
        try:
            made = write_map(_placed(log, globe, show), of_map, config=config, origin=origin, show=show)
        except OSError as error:
            raise cannot_write(of_map[0], error) from error
    return {
        "num_map_points": made.num_points,
        "num_map_moving_points": made.num_moving_points,
        "num_map_voxels_seen_through": made.num_voxels_seen_through,
        "map_seconds": perf_counter() - started,
    }


def _finished(log: RunLog) -> tuple[GraphEstimate, Trajectory]:
    result = log.result()
    if result is None:
        raise SegslamError(
            f"{log.path}: the run did not finish; run `segslam replay` on its log, or resume it with --resume"
        )
    return result


def _placed(log: RunLog, globe: "Globe | None", show: Progress) -> Iterator[tuple[Keyframe, Transform]]:
    """Each keyframe, its points corrected as in the adjustment of the run, with its final T_world_keyframe.

    The world of a georeferenced run is its local frame.
    """
    estimate, _ = _finished(log)
    adjustment = log.adjustment()
    raised_deg = 0.0 if adjustment is None else adjustment.correction_deg
    num_gathered = 0
    for row, step in enumerate(show(log.steps(), log.num_steps(), "gather")):
        if step.keyframe is not None:
            num_gathered += 1
            points = raise_beams(step.keyframe.points, raised_deg)
            T_world_keyframe = estimate.T_world_keyframe[step.keyframe.id] if globe is None else globe.T_enu_lidar[row]
            yield replace(step.keyframe, points=points), T_world_keyframe
    if num_gathered < len(estimate.T_world_keyframe):
        readable = f"only {num_gathered} of its {len(estimate.T_world_keyframe)} keyframes are readable"
        raise SegslamError(f"{log.path}: damaged, {readable}; the map is not written. Map the data again, or replay it")
