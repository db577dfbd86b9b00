"""The map of a finished run, written to files."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

from segslam.adjustment import Progress, no_progress
from segslam.config import MapConfig, load_config
from segslam.geometry import raise_beams
from segslam.log import RunLog, read_log
from segslam.map import check_files, write_map
from segslam.run.folder import log_of
from segslam.system.whole_files import cannot_write, whole_file
from segslam.types import Keyframe, SegslamError, Transform


def export(run: str | Path, files: Sequence[str | Path], *, settings: Sequence[str] = ()) -> dict[str, Any]:
    """Write the map of a finished run, like `segslam export`; existing files are replaced. Returns figures of the map.

    `files`: .ply .pcd .las .laz (cloud), .png (top view), .yaml (grid) or before_after.png; all are written, or none.
    `settings`: changes such as `"map.color=height"`. Raises SegslamError, naming the file and the remedy.
    """
    log = read_log(log_of(Path(run)))
    config = load_config(None, settings, base=log.config).map
    return write_maps(log, [Path(file) for file in files], config=config)


def write_maps(
    log: RunLog, files: Sequence[Path], *, config: MapConfig, show: Progress = no_progress
) -> dict[str, Any]:
    """Write the map of a finished run to each of the files, or to none. Returns figures of the map.

    `show` passes items on, and shows their number and a title.

    Raises SegslamError if the run did not finish or a name has an unknown extension, WorkFailed if the disk is full.
    """
    from segslam.run.report import BEFORE_AFTER, draw_before_after

    started = perf_counter()
    of_map = [file for file in files if file.name != BEFORE_AFTER]
    check_files(of_map)
    with ExitStack() as complete:  # moves each file to its name at the end, after a failure none
        for file in files:
            if file not in of_map:
                complete.enter_context(whole_file(file)).write_bytes(draw_before_after(log.path.parent))
        if not of_map:
            return {"map_seconds": perf_counter() - started}
        try:
            made = write_map(
                _placed(log, show), of_map, config=config, show=lambda parts, total: show(parts, total, "clean")
            )
        except OSError as error:
            raise cannot_write(of_map[0], error) from error
    return {
        "num_map_points": made.num_points,
        "num_map_moving_points": made.num_moving_points,
        "num_map_voxels_seen_through": made.num_voxels_seen_through,
        "map_seconds": perf_counter() - started,
    }


def _placed(log: RunLog, show: Progress) -> Iterator[tuple[Keyframe, Transform]]:
    """Each keyframe, its points corrected as in the adjustment of the run, with its final T_world_keyframe."""
    result = log.result()
    if result is None:
        raise SegslamError(
            f"{log.path}: the run did not finish; run `segslam replay` on its log, or resume it with --resume"
        )
    estimate, _ = result
    adjustment = log.adjustment()
    raised_deg = 0.0 if adjustment is None else adjustment.correction_deg
    num_gathered = 0
    for step in show(log.steps(), log.num_steps(), "gather"):
        if step.keyframe is not None:
            num_gathered += 1
            points = raise_beams(step.keyframe.points, raised_deg)
            yield replace(step.keyframe, points=points), estimate.T_world_keyframe[step.keyframe.id]
    if num_gathered < len(estimate.T_world_keyframe):
        readable = f"only {num_gathered} of its {len(estimate.T_world_keyframe)} keyframes are readable"
        raise SegslamError(f"{log.path}: damaged, {readable}; the map is not written. Map the data again, or replay it")
