"""`segslam bench`: the experiments of the paper, with all methods on the same scans."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from segslam.bench.experiments.method_settings import METHOD_NAMES
from segslam.cli.checks import check_free, check_own, make_folder
from segslam.cli.commands import GroupedCommands
from segslam.cli.console import Terminal
from segslam.cli.ending import is_interrupted
from segslam.cli.options import (
    DatasetOption,
    EncodingOption,
    LabelsOption,
    OverwriteOption,
    SequenceOption,
    Settings,
    with_options,
)
from segslam.cli.tables import aligned
from segslam.core.errors import SegslamError
from segslam.core.interrupts import EXIT_STATUS, when_stopped

if TYPE_CHECKING:
    from segslam.bench.experiments.job import Job
    from segslam.bench.experiments.pairs import PairList, Trial
    from segslam.bench.experiments.rows import Row
    from segslam.core.types import Trajectory

app = typer.Typer(
    cls=GroupedCommands,
    help="Repeat the experiments of the Segregator paper; every method gets the same scans.\n\n"
    "Example: segslam bench pairs kitti --sequence 06 --pairs kitti06_3to5.txt --sample 100 --out bench06",
    no_args_is_help=True,
)

LOST_PERCENT = [10.0, 30.0, 50.0, 70.0, 90.0]

DataArgument = Annotated[Path, "KITTI folder, with real or simulated scans."]


@dataclass(frozen=True)
class Options:
    """The options common to all experiments."""

    pairs: Annotated[
        list[Path] | None, "List of pairs: one `source target` per line, or JSON with their poses; may be repeated."
    ] = None
    min_m: Annotated[
        float | None, typer.Option(min=0, help="Make a list from the true poses: smallest distance of a pair (m).")
    ] = None
    max_m: Annotated[float | None, typer.Option(min=0, help="Largest distance of such a pair (m).")] = None
    min_gap: Annotated[int, typer.Option(min=1, help="Smallest number of scans between the two of such a pair.")] = 50
    sample: Annotated[int | None, typer.Option(min=1, help="Use only N pairs of each list, drawn at random.")] = None
    seed: Annotated[int, typer.Option(min=0, help="Random seed of --sample.")] = 0
    sequence: SequenceOption = "00"
    method: Annotated[
        list[str] | None,
        typer.Option(
            autocompletion=lambda: METHOD_NAMES,
            help=f"Method, may be repeated; default: all of {', '.join(METHOD_NAMES)}.",
        ),
    ] = None
    dataset: DatasetOption = None
    labels: LabelsOption = "auto"
    encoding: EncodingOption = None
    workers: Annotated[int, typer.Option(min=1, help="Number of processes on this machine (extra `cluster`).")] = 1
    scheduler: Annotated[str | None, "Address of a Dask cluster with access to DATA (extra `cluster`)."] = None
    out: Annotated[
        Path | None, "Folder for the report and the rows; the same command continues an interrupted benchmark there."
    ] = None
    details: Annotated[Path | None, "CSV file to write, one row per registration."] = None
    draw: Annotated[int, typer.Option(min=0, help="Draw the N worst failures; needs --out.")] = 0
    overwrite: OverwriteOption = False


@app.command()
@with_options
def pairs(data: DataArgument, options: Options, changes: Settings, terminal: Terminal) -> None:
    """Measure the success rate over lists of pairs.

    Example: segslam bench pairs kitti --sequence 06 --pairs kitti06_3to5.txt --sample 100 --workers 4 --out bench06
    """
    _experiment("pairs", data, options, changes, terminal, by="list")


@app.command(short_help="Measure times, errors and graph sizes.")
@with_options
def timing(data: DataArgument, options: Options, changes: Settings, terminal: Terminal) -> None:
    """Measure the time of each stage, the errors and the graph size, all lists together (paper: sequence 06).

    Example: segslam bench timing kitti --sequence 06 --pairs kitti06_3to5.txt --pairs kitti06_8to10.txt --sample 50
    """
    _experiment("timing", data, options, changes, terminal, by="list")


@app.command(short_help="Measure the error against the yaw of the source.")
@with_options
def yaw(
    data: DataArgument,
    *,
    options: Options,
    changes: Settings,
    step_deg: Annotated[float, typer.Option(min=1, max=180, help="Step between two yaw angles (degrees).")] = 15.0,
    terminal: Terminal,
) -> None:
    """Measure the error against the yaw of the source, over the full circle. Default pair: scans 0 and 10.

    Example: segslam bench yaw kitti --sequence 05 --step-deg 5 --out yaw05
    """
    varied = {"step_deg": step_deg}
    _experiment("yaw", data, options, changes, terminal, by="yaw_deg", varied=varied, asked=varied)


@app.command(short_help="Measure the success while labels are removed.")
@with_options
def deterioration(
    data: DataArgument,
    *,
    options: Options,
    changes: Settings,
    lost_percent: Annotated[
        list[float], typer.Option("--lost", min=0, max=100, help="Percentage of labels to remove; may be repeated.")
    ] = LOST_PERCENT,
    clouds: Annotated[Literal["one", "both"], "Remove labels from the source only, or from both scans."] = "both",
    draws: Annotated[int, typer.Option(min=1, help="Number of random draws at each percentage.")] = 10,
    terminal: Terminal,
) -> None:
    """Measure the success while labels are removed at random. Default pair: scans 0 and 10.

    Example: segslam bench deterioration kitti --sequence 05 --labels predictions --clouds one --out lost05
    """
    varied = {"lost_percent": lost_percent, "num_draws": draws, "seed": options.seed, "both": clouds == "both"}
    asked = {"clouds": clouds, "draws": draws}
    _experiment("deterioration", data, options, changes, terminal, by="lost_percent", varied=varied, asked=asked)


@app.command()
@with_options
def places(
    file: Annotated[Path, "Places: a .npz with `columns` (n, size, size) uint8 and `poses` (n, 3, 4)."],
    *,
    database: Annotated[str, "Rows of the database: A:B, B excluded."],
    queries: Annotated[str, "Rows of the queries: C:D."],
    turned: Annotated[bool, "Rotate each query by a random yaw."] = False,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of --turned.")] = 0,
    terminal: Terminal,
) -> None:
    """Measure how often a place is recognised, without labels. A hit is within 5 m; queries without one are omitted.

    Example: segslam bench places kitti_00.npz --database 0:3000 --queries 3200:
    """
    from segslam.bench.experiments.places import measure, parse_range, read_places

    terminal.announce(f"bench places: reading {file}")
    seen = read_places(file)
    figures = measure(
        seen,
        parse_range(database, "--database", len(seen)),
        parse_range(queries, "--queries", len(seen)),
        turned_seed=seed if turned else None,
        progress=terminal.progress,
    )
    terminal.answer(
        figures,
        f"{figures['num_queries']} queries of {figures['num_places']} places: recall@1 {figures['recall_at_1']:.3f}, "
        f"recall@20 {figures['recall_at_20']:.3f}; {figures['query_ms']:.1f} ms per query, "
        f"{figures['index_bytes']} bytes per place",
    )


def _make_job(data: Path, options: Options, changes: Settings, terminal: Terminal) -> "Job":
    """The job that the options describe. By default, methods that are not installed are skipped with a message."""
    check_free([options.details], overwrite=options.overwrite)
    if options.out is not None:
        check_own(options.out, "asked.json")
    terminal.announce(f"bench: opening {data}")
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        # before Open3D and others are loaded, because times are per core
        os.environ.setdefault(variable, "1")
    from segslam.bench.experiments.job import Job
    from segslam.bench.experiments.methods import find_method
    from segslam.scans import DataSource

    if options.draw and options.out is None:
        raise SegslamError("--draw: pictures need a folder; give --out DIR")
    chosen = []
    for name in dict.fromkeys(options.method or METHOD_NAMES):
        try:
            find_method(name)
        except SegslamError as error:
            if options.method:
                raise
            terminal.say(f"method skipped: {error}")
        else:
            chosen.append(name)
    config = changes.load()
    source = DataSource(
        data.expanduser().absolute(),
        options.sequence,
        options.dataset,
        options.labels,
        options.encoding,
        vertical_angle_deg=config.sensor.vertical_angle_deg,
    )
    return Job(source, tuple(chosen), config)


def _read_lists(
    options: Options, reference: "Trajectory | None", *, default: "PairList | None" = None
) -> list["PairList"]:
    """The lists from files, or the list selected by distance, or the default; sampled if requested."""
    from segslam.bench.experiments.pairs import cut_pairs, read_pairs, sample_pairs

    low_m, high_m = options.min_m, options.max_m
    cuts = low_m is not None or high_m is not None
    if options.pairs and cuts:
        raise SegslamError("--pairs, --min-m: give lists of pairs, or make one with --min-m and --max-m, not both")
    if options.pairs:
        files = list(dict.fromkeys(options.pairs))
        lists = [read_pairs(file) for file in files]
        names = [one.name for one in lists]  # equal ones are of files in other folders
        shown = [name if names.count(name) == 1 else str(file) for name, file in zip(names, files, strict=True)]
        lists = [replace(one, name=name) for one, name in zip(lists, shown, strict=True)]
    elif cuts:
        if reference is None:
            raise SegslamError("--min-m: the data has no true poses; give lists with --pairs FILE")
        if low_m is None or high_m is None or not low_m < high_m:
            raise SegslamError(f"--min-m {low_m} --max-m {high_m}: give both, the smaller one first")
        name = f"cut_{low_m:g}to{high_m:g}"
        lists = [cut_pairs(reference, name=name, min_m=low_m, max_m=high_m, min_gap=options.min_gap)]
        if len(lists[0].pairs) == 0:
            raise SegslamError(f"--min-m {low_m:g} --max-m {high_m:g}: no two scans of the data are this far apart")
    elif default is not None:
        lists = [default]
    else:
        raise SegslamError("--pairs: give a list of pairs, or make one from the true poses with --min-m and --max-m")
    return [sample_pairs(one, num_pairs=options.sample, seed=options.seed) for one in lists]


def _experiment(
    name: str,
    data: Path,
    options: Options,
    changes: Settings,
    terminal: Terminal,
    *,
    by: str,
    varied: Mapping[str, Any] = MappingProxyType({}),
    asked: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Register the pairs, print the results, and write the report if a folder is given.

    `varied`: arguments of `pair_trials`; if there are some, the default is the pair of the paper. `asked` is for the
    report.
    """
    job = _make_job(data, options, changes, terminal)
    from segslam.bench.experiments.benchmark import in_order, rows_before, run
    from segslam.bench.experiments.job import open_once
    from segslam.bench.experiments.pairs import PAPER_PAIR, pair_trials, scans_named
    from segslam.bench.experiments.paper import with_paper_values
    from segslam.bench.experiments.provenance import account
    from segslam.bench.experiments.report_tables import overall
    from segslam.bench.experiments.rows import results, write_rows

    scans, row_of_scan = open_once(job.source)
    reference = scans.reference
    lists = _read_lists(options, reference, default=PAPER_PAIR if varied else None)
    if missing := sorted(scans_named(lists) - row_of_scan.keys()):
        raise SegslamError(
            f"{data}: scan {missing[0]} has no file, nor have {len(missing) - 1} other scans of the pairs; put them "
            "there, or give a list whose scans are all there"
        )
    trials = [trial for one in lists for trial in pair_trials(one, reference, **varied)]
    if options.out is not None and options.overwrite:
        make_folder(options.out, overwrite=True, inputs=[data, *(options.pairs or [])], made_by=("asked.json",))
    terminal.compile_kernels()
    rows: list[Row] = []
    kept = f"are kept in {options.out}; the same command continues" if options.out else "are lost; --out keeps them"
    when_stopped(f"the finished registrations {kept}")
    before = rows_before(options.out, job, trials) if options.out else []
    work = run(job, trials, workers=options.workers, scheduler=options.scheduler, folder=options.out, before=before)
    num_before = len({row.trial_key for row in before})
    shown = terminal.progress(work, len(trials), "bench", num_before=num_before)
    if is_interrupted(map(rows.extend, shown)):
        when_stopped(f"{len(rows)} registrations {kept}")
        raise typer.Exit(EXIT_STATUS)
    rows = in_order(rows, job, trials)
    if options.details is not None:
        write_rows(options.details, rows)
    found = with_paper_values(results(rows, by=by), experiment=name, sequence=options.sequence, lists=lists)
    if options.out is not None:
        from segslam.bench.experiments.report import write_bench_report

        workers = "of a Dask cluster" if options.scheduler else options.workers
        shared = {"sample": options.sample, "seed": options.seed, "workers": workers}
        report = account(name, job, lists, found, options={**shared, **asked})
        write_bench_report(options.out, report, pictures=_pictures(job, trials, rows, options.draw))
        terminal.say(f"{options.out / 'report.html'}, report.md, report.json, details.csv")
    table = overall(found)
    terminal.table(found, aligned([table.head, *table.rows]))


def _pictures(job: "Job", trials: list["Trial"], rows: list["Row"], count: int) -> dict[str, bytes]:
    """Pictures of the worst failures, by caption."""
    from segslam.bench.experiments.job import BAD_SCAN, points_of
    from segslam.bench.experiments.rows import worst_failures
    from segslam.output.report.loops import draw_pair

    trial_of = {trial.key: trial for trial in trials}
    pictures = {}
    for row in worst_failures([row for row in rows if row.reason != BAD_SCAN], count):
        trial = trial_of[row.trial_key]
        outcome = f"error {row.error_m:.1f} m {row.error_deg:.1f} deg" if row.accepted else row.reason.replace("_", " ")
        turned = f", rotated by {row.source_yaw_deg:g} deg" if row.source_yaw_deg else ""
        lost = f", {100 * row.source_lost:g} % of labels lost" if row.source_lost else ""
        caption = f"{row.method}, {row.pairs}: {row.source} to {row.target}{turned}{lost}, {outcome}"
        poses = {"truth": trial.T_target_source} | ({} if row.estimate is None else {"estimate": row.estimate})
        source, target = points_of(job.source, trial.source), points_of(job.source, trial.target)
        pictures[caption] = draw_pair(source, target, poses=poses, title=caption)
    return pictures
