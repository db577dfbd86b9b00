"""`segslam map`, `localise` and `resume`: scans become a run."""

import json as json_text
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import (
    check_exists,
    check_free,
    check_preset,
    check_same,
    check_scans,
    has_results,
    is_finished,
    log_to_resume,
    make_folder,
    outside,
    preset_config,
    why_not_resumed,
)
from segslam.cli.console import Terminal, how_to_go_on, print_json, say
from segslam.cli.dry_run import first_usable, found_in, lines
from segslam.cli.ending import finish, is_interrupted, map_summary
from segslam.cli.options import DataArgument, GnssOptions, RunOptions, RunOutput, ViewOption
from segslam.cli.viewers import check_display, scene_in, serve_foxglove
from segslam.core.errors import SegslamError
from segslam.core.interrupts import EXIT_STATUS, when_stopped

if TYPE_CHECKING:
    from segslam.core.config import Config
    from segslam.core.types import BadScan, Step
    from segslam.odometry.sweep import Odometry
    from segslam.output.log import RunLog
    from segslam.run.map_folder import SlamOf
    from segslam.scans import Dataset

FREE_OPTIONS = ("data", "dataset", "sequence", "map_files", "gnss", "gnss_use", "gnss_offset")
"""Options in the log that may be others when the run is resumed, as long as the data is the same."""


def map_command(
    data: DataArgument,
    *,
    out: Annotated[Path | None, "New folder for the run; with --resume the folder of the run.  [required]"] = None,
    options: RunOptions,
    output: RunOutput,
    gnss: GnssOptions,
    dry_run: Annotated[bool, "Show the content of DATA and the settings; write nothing. Needs no --out."] = False,
    terminal: Terminal,
) -> None:
    """Map scans: write the corrected trajectory, the loops, a log, a report and, with ground truth, the error.

    Example: segslam map kitti --sequence 00 --frames 0:1000 --out runs/00
    """
    if out is None and not dry_run:
        raise SegslamError("--out: give a new folder for the run, as in --out runs/00 (to look first: --dry-run)")
    map_data(data, out or Path(), options, output, terminal, gnss, dry_run=dry_run)


def localise(
    run: Annotated[Path, "Folder of the finished run that provides the map. It is not changed."],
    data: DataArgument,
    *,
    out: Annotated[Path, "New folder for the run; with --resume the folder of the run."],
    options: RunOptions,
    output: RunOutput,
    terminal: Terminal,
) -> None:
    """Localise new scans in the map of an earlier run; writes a run folder like `map`, in the frame of the earlier run.

    The first pose is found without initial guess, and likewise after tracking is lost. Scans far from every pose found
    in the map are marked in localised.csv and omitted from poses_tum.txt. Example: segslam localise runs/monday
    friday_scans --out runs/friday
    """
    check_exists(run, "give the folder of a finished run")
    map_data(data, out, options, output, terminal, GnssOptions(), in_map=run)


def resume(
    run: Annotated[Path, "Folder of the interrupted run, or its log.mcap."],
    *,
    view: ViewOption = False,
    terminal: Terminal,
) -> None:
    """Continue an interrupted run with its original data and options, which are read from its log.

    Example: segslam resume runs/00
    """
    check_exists(run, "give a run folder")
    terminal.announce(f"resume: reading {run}")
    from segslam.output.finished import read_metrics
    from segslam.output.folder import folder_of

    run = folder_of(run)
    recorded = log_to_resume(run)
    chosen: dict[str, Any] = {name: value for name, value in recorded.options.items() if value}
    again = f"segslam map DATA --out {shlex.quote(str(run))} --resume"
    if "data" not in chosen and has_results(recorded) and not read_metrics(run).get("num_scans_left"):
        _show_complete(recorded, [], terminal, place=None)  # live, merged or replayed
        return
    if why := why_not_resumed(chosen, run):
        raise SegslamError(f"{recorded.path}: {why}")
    if "data" not in chosen:
        raise SegslamError(f"{recorded.path}: has no path of the data; resume with: {again}")
    data = Path(chosen["data"])
    check_exists(data, f"{recorded.path} was started with it. Restore it, or: {again}")
    from segslam.labels.encodings import ENCODINGS

    if (numbering := chosen.get("encoding", "raw")) not in ENCODINGS:
        raise SegslamError(f"{recorded.path}: --encoding {numbering}: unknown; resume with: {again}")
    names = ("dataset", "sequence", "frames", "topic", "labels", "encoding")
    options = RunOptions(
        **{name: chosen[name] for name in names if name in chosen},
        odometry=Path(chosen["odometry"]) if "odometry" in chosen else None,
        resume=True,
    )
    output = RunOutput(map_file=_map_files(chosen.get("map_files", "[]"), run, recorded.path, terminal), view=view)
    in_map = Path(chosen["in_map"]) if "in_map" in chosen else None
    map_data(data, run, options, output, terminal, GnssOptions.of(chosen), in_map=in_map)


def _map_files(names: str, run: Path, log: Path, terminal: Terminal) -> list[Path]:
    """The map files that a log names, without those outside of the run folder: the log may come from another person."""
    try:
        files = [Path(str(name)) for name in json_text.loads(names)]
    except (ValueError, TypeError) as error:
        raise SegslamError(
            f"{log}: damaged list of map files ({names[:80]}); resume with: "
            f"segslam map DATA --out {shlex.quote(str(run))} --resume"
        ) from error
    left_out = [file for file in files if outside([run / file], run)]
    for file in left_out:
        terminal.say(f"{file}: not written, because it is outside of {run}; after this: segslam export {run} {file}")
    return [file for file in files if file not in left_out]


def map_data(
    data: Path,
    folder: Path,
    options: RunOptions,
    output: RunOutput,
    terminal: Terminal,
    gnss: GnssOptions,
    *,
    dry_run: bool = False,
    in_map: Path | None = None,
    go_on: str | None = None,
) -> None:
    """Map scans into a folder, or localise them in the map of the run `in_map`; `dry_run` prints what would be done.

    `go_on`: how to continue a run that was stopped, by default with the command `resume`.
    """
    if output.view:
        check_display()
    if options.resume and output.overwrite:
        raise SegslamError("--overwrite: a resumed run is continued, not replaced; give --resume or --overwrite")
    check_scans(data)
    recorded = log_to_resume(folder) if options.resume and not dry_run else None
    check_preset(options.preset, resumes=recorded is not None)
    settings = output.load(base=recorded.config if recorded else None)
    terminal.announce(f"map: opening {data}" if in_map is None else f"localise: reading the map of {in_map}")
    slam_of, place = _in_map(in_map)
    from segslam.run.map_folder import given_odometry, in_effect, open_scans, resume_options

    map_names, map_files = output.maps(folder)
    check_free(outside(map_files, folder), overwrite=output.overwrite or options.resume)
    source = options.source(data, options.labels, options.encoding)
    scans = open_scans(source, settings)
    if settings.map.color == "intensity" and first_usable(scans)[1].intensities is None:
        raise SegslamError(f"map.color=intensity: {scans.name} has no intensities; use class or height")
    choices = resume_options(source, odometry=options.odometry, map_files=map_names) | gnss.recorded()
    place = gnss.placing(data) or place
    choices |= {"in_map": str(in_map.expanduser().resolve())} if in_map else {}
    if recorded is None:
        settings = output.load(base=preset_config(options.preset, scans, terminal))
    given = given_odometry(options.odometry, scans, settings.odometry) if options.odometry else None
    if dry_run:
        found = found_in(scans, settings)
        terminal.table(found, lines(found))
        return
    if recorded is not None:
        repeated = {name: value for name, value in choices.items() if name not in FREE_OPTIONS}
        check_same(recorded, settings, dataset=scans.name, options=repeated)
        if is_finished(recorded, scans):
            _show_complete(recorded, map_files, terminal, place=place)
            return
    _map_scans(
        scans,
        folder,
        output,
        terminal,
        inputs=(data, in_map, options.odometry),
        settings=in_effect(settings, scans.vertical_angle_deg),
        odometry=given,
        options=choices,
        recorded=recorded,
        map_files=map_files,
        slam_of=slam_of,
        place=place,
        go_on=go_on or f"continue with: segslam resume {shlex.quote(str(folder))}",
    )


def _in_map(in_map: Path | None) -> "tuple[SlamOf | None, Callable[[Path], str] | None]":
    """What makes pipelines that localise in the map of a run, and what gives its place on the globe to a run."""
    if in_map is None:
        return None, None
    from segslam.output.georeferenced import take_over
    from segslam.run.sessions.localiser import localiser_in

    return localiser_in(in_map), partial(take_over, map_run=in_map)


def _show_complete(
    recorded: "RunLog", map_files: Sequence[Path], terminal: Terminal, *, place: Callable[[Path], str] | None
) -> None:
    """Give a finished run a place on the globe if it has none, write its missing maps, and show its figures."""
    from segslam.output.export import write_maps
    from segslam.output.finished import read_metrics
    from segslam.output.folder import PLACE_ON_GLOBE
    from segslam.output.report import write_report

    folder = recorded.path.parent
    terminal.say(f"{folder}: the run is already complete; no scan is left to map")
    if place is not None and not (folder / PLACE_ON_GLOBE).exists():
        terminal.say(place(folder))
        write_report(folder)
    if missing := [file for file in map_files if not file.exists()]:
        made = write_maps(recorded, missing, config=recorded.config.map, show=terminal.progress)
        terminal.say(map_summary(made, missing))
    if terminal.json:
        print_json(read_metrics(folder))


def _map_scans(
    scans: "Dataset",
    folder: Path,
    output: RunOutput,
    terminal: Terminal,
    *,
    inputs: Iterable[Path | None],
    settings: "Config",
    odometry: "Odometry | None",
    options: Mapping[str, str],
    recorded: "RunLog | None",
    map_files: Sequence[Path],
    slam_of: "SlamOf | None",
    place: Callable[[Path], str] | None,
    go_on: str,
) -> None:
    """Map a data set into a new folder, or resume the run `recorded`, and show the figures.

    `inputs`: what must not be in a folder that is replaced. `slam_of` creates the pipeline, `place` georeferences the
    run. Raises typer.Exit(130) if Ctrl-C ended the run early; `go_on` is then printed.
    """
    from segslam.odometry.apart import OdometryApart
    from segslam.run.map_folder import begun
    from segslam.slam.slam import Slam

    with ExitStack() as stack:
        scene = stack.enter_context(scene_in(None)) if output.view else None
        server = serve_foxglove(output.foxglove, stack, terminal)
        if recorded is None:
            make_folder(folder, overwrite=output.overwrite, inputs=inputs)
        terminal.compile_kernels()
        for file in map_files:
            file.parent.mkdir(parents=True, exist_ok=True)
        when_stopped(f"the log in {folder} is kept; {go_on}")
        stack.enter_context(how_to_go_on(f"{go_on} when there is space", folder))

        def watched(steps: "Iterator[Step | BadScan]", total: int, title: str) -> bool:
            """Shows each step and progress; True if Ctrl-C ended it early."""
            shown = terminal.progress(steps, total, title)
            return is_interrupted(map(scene.add, shown) if scene else shown)

        compares = scans.reference is not None  # KISS-ICP alone is for errors, and may take half of the time
        apart = OdometryApart(settings.odometry, keeps_alone=compares) if odometry is None else nullcontext(odometry)
        with apart as used:
            run = stack.enter_context(
                begun(
                    scans,
                    folder,
                    settings,
                    odometry=used,
                    slam_of=slam_of or Slam,
                    options=options,
                    resumes=recorded is not None,
                    mirror=server.send if server else None,
                )
            )
            if recorded is not None and watched(run.resume(recorded, scans), recorded.num_steps(), "resume"):
                raise typer.Exit(EXIT_STATUS)  # the log is as before
            left = len(scans) - run.num_scans_resumed - run.num_scans_skipped
            stopped = watched(run.map(scans), left, "map" if slam_of is None else "localise")
        if stopped and run.num_steps == 0:
            when_stopped("no scan was mapped, nothing was written")
            raise typer.Exit(EXIT_STATUS)
        more = {} if recorded is None else {"num_scans_resumed": run.num_scans_resumed}
        more |= {"num_scans_left": len(scans) - run.num_steps - run.num_scans_skipped} if stopped else {}
        metrics = finish(run, terminal, map_files=map_files, more=lambda _: more, stopped=stopped, place=place)
    if stopped:
        when_stopped(f"{metrics['num_scans']} of {len(scans)} scans are mapped; {go_on}")
        raise typer.Exit(EXIT_STATUS)
    if metrics.get("localised_percent") == 0.0:
        say(f"segslam: {scans.name}: no scan was found in the map; {folder} has the odometry only")
        raise typer.Exit(1)
