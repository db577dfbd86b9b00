"""`segslam map`."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated

import typer

from segslam.cli.checks import check_exists, check_intensities, check_same, is_finished, log_to_resume
from segslam.cli.compiling import compile_kernels
from segslam.cli.console import announce, how_to_go_on, print_json, print_out, progress, say
from segslam.cli.ending import finish
from segslam.cli.export import map_summary, write_maps
from segslam.cli.foxglove import serve_foxglove
from segslam.cli.gnss_options import GnssOptions
from segslam.cli.in_map import pipeline, placing_in
from segslam.cli.overwriting import check_free, make_room
from segslam.cli.preset import check_preset, preset_config
from segslam.cli.run_options import DataArgument, DryRunOption, OutputOptions, RunOptions
from segslam.cli.shared_options import with_options
from segslam.cli.view import check_display, close_scene, open_scene
from segslam.core.errors import SegslamError
from segslam.core.interrupts import EXIT_STATUS, when_stopped

if TYPE_CHECKING:
    from segslam.core.config import Config, MapConfig
    from segslam.core.types import BadScan, Step
    from segslam.odometry import Odometry
    from segslam.output.log import Mirror, RunLog
    from segslam.run.map_folder import SlamOf
    from segslam.run.run import Run
    from segslam.scans import Dataset

FREE_OPTIONS = ("data", "dataset", "sequence", "map_files", "gnss", "gnss_use", "gnss_offset")
"""Options in the log that may be others when the run is resumed, as long as the data is the same."""
NO_GNSS = GnssOptions()


@with_options
def map_command(
    data: DataArgument,
    *,
    out: Annotated[
        Path | None, typer.Option(help="New folder for the run; with --resume the folder of the run.  [required]")
    ] = None,
    options: RunOptions,
    output: OutputOptions,
    gnss: GnssOptions,
    dry_run: DryRunOption = False,
) -> None:
    """Map scans: write the corrected trajectory, the loops, a log, a report and, with ground truth, the error.

    Example: segslam map kitti --sequence 00 --frames 0:1000 --out runs/00
    """
    if out is None and not dry_run:
        raise SegslamError("--out: give a new folder for the run, as in --out runs/00 (to look first: --dry-run)")
    map_data(data, out or Path(), options, output, gnss, dry_run=dry_run)


def map_data(
    data: Path,
    folder: Path,
    options: RunOptions,
    output: OutputOptions,
    gnss: GnssOptions = NO_GNSS,
    *,
    dry_run: bool = False,
    in_map: Path | None = None,
) -> None:
    """Map scans into a folder, or localise them in the map of the run `in_map`; `dry_run` prints what would be done."""
    quiet = output.quiet
    if output.view:
        check_display()
    if options.resume and output.overwrite:
        raise SegslamError("--overwrite: a resumed run is continued, not replaced; give --resume or --overwrite")
    check_exists(data, "give the folder with sequences/ or with the scans")
    recorded = log_to_resume(folder) if options.resume and not dry_run else None
    check_preset(options.preset, resumes=recorded is not None)
    settings = output.load_config(base=recorded.config if recorded else None)
    announce(f"map: opening {data}" if in_map is None else f"localise: reading the map of {in_map}", quiet=quiet)
    slam_of = pipeline(in_map)
    from segslam.run.given_odometry import given_odometry
    from segslam.run.map_folder import open_scans, resume_options

    map_names, map_files = output.maps(folder)
    check_free([file for file in map_files if folder not in file.parents], overwrite=output.overwrite or options.resume)
    scans = open_scans(options.source(data), settings)
    if settings.map.color == "intensity":
        check_intensities(scans)
    choices = resume_options(options.source(data), odometry=options.odometry, map_files=map_names)
    place = gnss.placing(data) or placing_in(in_map)
    choices |= gnss.recorded()
    choices |= {"in_map": str(in_map.expanduser().resolve())} if in_map else {}
    if recorded is None:
        settings = output.load_config(base=preset_config(options.preset, scans, quiet=quiet))
    given = given_odometry(options.odometry, scans, settings.odometry) if options.odometry else None
    if dry_run:
        _show_dry_run(scans, settings, json=output.json, quiet=quiet)
        return
    if recorded is not None:
        repeated = {name: value for name, value in choices.items() if name not in FREE_OPTIONS}
        check_same(recorded, settings, dataset=scans.name, options=repeated)
        if is_finished(recorded, scans):
            _complete(recorded, map_files, config=settings.map, json=output.json, quiet=quiet)
            raise typer.Exit(0)
    else:
        inputs = [path for path in (data, in_map, options.odometry) if path is not None]
        make_room(folder, overwrite=output.overwrite, inputs=inputs)
    scene = open_scene(None, view_every=settings.log.view_every) if output.view else None
    with ExitStack() as stack:
        server = serve_foxglove(output.foxglove, stack, quiet=quiet)
        map_scans(
            scans,
            folder,
            settings=settings,
            odometry=given,
            options=choices,
            recorded=recorded,
            map_files=map_files,
            watch=scene.add if scene else _nobody,
            go_on=f"continue with: segslam resume {shlex.quote(str(folder))}",
            slam_of=slam_of,
            place=place,
            mirror=server.send if server else None,
            json=output.json,
            quiet=quiet,
        )
    if scene:
        close_scene(scene, None)


def _show_dry_run(scans: "Dataset", settings: "Config", *, json: bool, quiet: bool) -> None:
    from segslam.cli.dry_run import found_in, lines

    found = found_in(scans, settings)
    if json:
        print_json(found)
    elif not quiet:
        print_out(lines(found))


def _complete(recorded: "RunLog", map_files: Sequence[Path], *, config: "MapConfig", json: bool, quiet: bool) -> None:
    """Write the missing maps of a finished run, and show its figures."""
    from segslam.output.finished import read_metrics

    folder = recorded.path.parent
    say(f"{folder}: the run is already complete; there is nothing to resume", quiet=quiet)
    if missing := [file for file in map_files if not file.exists()]:
        made = write_maps(recorded, missing, config=config, quiet=quiet)
        say(map_summary(made, missing), quiet=quiet)
    if json:
        print_json(read_metrics(folder))


def _nobody(_: "Step | BadScan") -> None:
    """Default observer of steps: does nothing."""


def map_scans(
    scans: "Dataset",
    out: Path,
    *,
    settings: "Config",
    odometry: "Odometry | None" = None,
    options: Mapping[str, str] = MappingProxyType({}),
    recorded: "RunLog | None" = None,
    map_files: Sequence[Path] = (),
    watch: "Callable[[Step | BadScan], None]" = _nobody,
    mirror: "Mirror | None" = None,
    slam_of: "SlamOf | None" = None,
    place: Callable[[Path], str] | None = None,
    go_on: str,
    json: bool,
    quiet: bool,
) -> None:
    """Map a data set into a new folder, or resume the run `recorded`, and show the figures.

    The run keeps the vertical angle with which the data set was opened.
    `watch` is called with each step, `mirror` with each message of the log; `slam_of` creates the pipeline, `place`
    georeferences the run. Raises
    typer.Exit(130) if Ctrl-C ended the run early; `go_on`, the command that continues it, is then printed.
    """
    from segslam.odometry import OdometryApart
    from segslam.output.folder import new_folder
    from segslam.run.map_folder import in_effect, labeller_of
    from segslam.run.run import Run
    from segslam.slam.slam import Slam

    settings = in_effect(settings, scans)
    folder = out if recorded else new_folder(out)
    compile_kernels(quiet=quiet)
    for file in map_files:
        file.parent.mkdir(parents=True, exist_ok=True)
    when_stopped(f"the log in {folder} is kept; {go_on}")
    apart = OdometryApart(settings.odometry, keeps_alone=True) if odometry is None else None
    with (
        how_to_go_on(f"{go_on} when there is space"),
        apart or nullcontext(),
        Run(
            folder,
            (slam_of or Slam)(settings, odometry=odometry or apart, labeller=labeller_of(scans)),
            dataset=scans.name,
            T_camera_lidar=scans.T_camera_lidar,
            reference=scans.reference,
            options=options,
            resumes=recorded is not None,
            mirror=mirror,
        ) as run,
    ):
        with apart or nullcontext():
            if recorded is not None:
                _take_over(run, recorded, scans, watch, quiet=quiet)
            title = "map" if slam_of is None else "localise"
            interrupted = _process(run, scans, watch, title=title, quiet=quiet)
        if interrupted and run.num_steps == 0:
            when_stopped("no scan was mapped, nothing was written")
            raise typer.Exit(EXIT_STATUS)
        resumed = {} if recorded is None else {"num_scans_resumed": run.num_scans_resumed}
        metrics = finish(
            run,
            scans.reference,
            map_files=map_files,
            json=json,
            quiet=quiet,
            more=lambda _: resumed,
            stopped=interrupted,
            place=place,
        )
    if interrupted:
        when_stopped(f"{metrics['num_scans']} of {len(scans)} scans are mapped; {go_on}")
        raise typer.Exit(EXIT_STATUS)
    if metrics.get("localised_percent") == 0.0:
        say(f"segslam: {scans.name}: no scan was found in the map; {folder} has the odometry only")
        raise typer.Exit(1)


def _take_over(
    run: "Run", recorded: "RunLog", scans: "Dataset", watch: "Callable[[Step | BadScan], None]", *, quiet: bool
) -> None:
    """Repeat the steps in the log. Raises typer.Exit(130) after Ctrl-C, which leaves the log unchanged."""
    try:
        for step in progress(run.resume(recorded, scans), total=recorded.num_steps(), title="resume", quiet=quiet):
            watch(step)
    except KeyboardInterrupt as interrupt:
        raise typer.Exit(EXIT_STATUS) from interrupt


def _process(
    run: "Run", scans: "Dataset", watch: "Callable[[Step | BadScan], None]", *, title: str, quiet: bool
) -> bool:
    """Map or localise every scan. Returns True if Ctrl-C ended it before the last one."""
    with suppress(KeyboardInterrupt):
        left = len(scans) - run.num_scans_resumed - run.num_scans_skipped
        for step in progress(run.map(scans), total=left, title=title, quiet=quiet):
            watch(step)
        return False
    return True
