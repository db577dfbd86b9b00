"""Options and steps common to all commands of `segslam bench`: open, run, report."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.bench.experiments.method_settings import METHOD_NAMES
from segslam.cli.compiling import compile_kernels
from segslam.cli.completion import METHODS
from segslam.cli.console import (
    ConfigOption,
    DatasetOption,
    EncodingOption,
    JsonOption,
    LabelsOption,
    QuietOption,
    SequenceOption,
    SetOption,
    announce,
    progress,
    say,
)
from segslam.core.errors import SegslamError
from segslam.core.interrupts import EXIT_STATUS, when_stopped
from segslam.core.whole_files import check_target

if TYPE_CHECKING:
    from segslam.bench.experiments.job import Job
    from segslam.bench.experiments.pairs import PairList
    from segslam.bench.experiments.rows import Row
    from segslam.bench.experiments.trials import Trial
    from segslam.core.types import Trajectory

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")

DataArgument = Annotated[Path, typer.Argument(help="KITTI folder, with real or simulated scans.")]


@dataclass(frozen=True)
class Options:
    """The options common to all experiments."""

    pairs: Annotated[
        list[Path] | None,
        typer.Option(
            "--pairs", help="List of pairs: one `source target` per line, or JSON with their poses; may be repeated."
        ),
    ] = None
    min_m: Annotated[
        float | None,
        typer.Option("--min-m", min=0, help="Make a list from the true poses: smallest distance of a pair (m)."),
    ] = None
    max_m: Annotated[float | None, typer.Option("--max-m", min=0, help="Largest distance of such a pair (m).")] = None
    min_gap: Annotated[
        int, typer.Option("--min-gap", min=1, help="Smallest number of scans between the two of such a pair.")
    ] = 50
    sample: Annotated[
        int | None, typer.Option("--sample", min=1, help="Use only N pairs of each list, drawn at random.")
    ] = None
    seed: Annotated[int, typer.Option("--seed", min=0, help="Random seed of --sample.")] = 0
    sequence: SequenceOption = "00"
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method",
            autocompletion=METHODS,
            help=f"Method, may be repeated; default: all of {', '.join(METHOD_NAMES)}.",
        ),
    ] = None
    dataset: DatasetOption = None
    labels: LabelsOption = "auto"
    encoding: EncodingOption = None
    config: ConfigOption = None
    settings: SetOption = None
    workers: Annotated[
        int, typer.Option("--workers", min=1, help="Number of processes on this machine (extra `cluster`).")
    ] = 1
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="Address of a Dask cluster with access to DATA (extra `cluster`).")
    ] = None
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Folder for the report and the rows; the same command continues an interrupted benchmark there.",
        ),
    ] = None
    details: Annotated[Path | None, typer.Option("--details", help="CSV file to write, one row per registration.")] = (
        None
    )
    draw: Annotated[int, typer.Option("--draw", min=0, help="Draw the N worst failures; needs --out.")] = 0
    json: JsonOption = False
    quiet: QuietOption = False


def make_job(data: Path, options: Options) -> "Job":
    """The job that the options describe. By default, methods that are not installed are skipped with a message."""
    announce(f"bench: opening {data}", quiet=options.quiet)
    _one_thread_each()
    from segslam.bench.experiments.job import Job
    from segslam.bench.experiments.methods import find_method
    from segslam.core.config import load_config
    from segslam.scans import DataSource

    if options.details is not None:
        check_target(options.details)
    if options.draw and options.out is None:
        raise SegslamError("--draw: pictures need a folder; give --out DIR")
    chosen = []
    for name in dict.fromkeys(options.method or METHOD_NAMES):
        try:
            find_method(name)
        except SegslamError as error:
            if options.method:
                raise
            say(f"method skipped: {error}", quiet=options.quiet)
        else:
            chosen.append(name)
    config = load_config(options.config, options.settings or ())
    source = DataSource(
        data.expanduser().absolute(),
        options.sequence,
        options.dataset,
        options.labels,
        options.encoding,
        vertical_angle_deg=config.sensor.vertical_angle_deg,
    )
    return Job(source, tuple(chosen), config)


def reference_of(job: "Job") -> "Trajectory | None":
    """The true poses of the data set."""
    from segslam.bench.experiments.job import open_once

    dataset, _ = open_once(job.source)
    return dataset.reference


def read_lists(
    options: Options, reference: "Trajectory | None", *, default: "PairList | None" = None
) -> list["PairList"]:
    """The lists from files, or the list selected by distance, or the default; sampled if requested."""
    from segslam.bench.experiments.pairs import cut_pairs, read_pairs, sample_pairs

    cuts = options.min_m is not None or options.max_m is not None
    if options.pairs and cuts:
        raise SegslamError("--pairs, --min-m: give lists of pairs, or make one with --min-m and --max-m, not both")
    if options.pairs:
        lists = [read_pairs(file) for file in options.pairs]
    elif cuts:
        lists = [cut_pairs(_posed(reference), **_bounds(options))]
    elif default is not None:
        lists = [default]
    else:
        raise SegslamError("--pairs: give a list of pairs, or make one from the true poses with --min-m and --max-m")
    if options.sample is None:
        return lists
    return [sample_pairs(one, num_pairs=options.sample, seed=options.seed) for one in lists]


def run_trials(job: "Job", trials: list["Trial"], options: Options) -> list["Row"]:
    """All rows in the order of the trials. After Ctrl-C, finished rows remain in the folder of `--out`."""
    from segslam.bench.experiments.benchmark import Pool, in_order, run
    from segslam.bench.experiments.rows import write_rows

    compile_kernels(quiet=options.quiet)
    rows: list[Row] = []
    pool = Pool(options.workers, options.scheduler)
    kept = f"are kept in {options.out}; the same command continues" if options.out else "are lost; --out keeps them"
    when_stopped(f"the finished registrations {kept}")
    work = run(job, trials, pool=pool, folder=options.out)
    try:
        for some in progress(work, total=len(trials), title="bench", quiet=options.quiet):
            rows += some
    except KeyboardInterrupt:
        when_stopped(f"{len(rows)} registrations {kept}")
        raise typer.Exit(EXIT_STATUS) from None
    rows = in_order(rows, job, trials)
    if options.details is not None:
        write_rows(options.details, rows)
    return rows


def _bounds(options: Options) -> dict[str, Any]:
    if options.min_m is None or options.max_m is None or not options.min_m < options.max_m:
        raise SegslamError(f"--min-m {options.min_m} --max-m {options.max_m}: give both, the smaller one first")
    name = f"cut_{options.min_m:g}to{options.max_m:g}"
    return {"name": name, "min_m": options.min_m, "max_m": options.max_m, "min_gap": options.min_gap}


def _posed(reference: "Trajectory | None") -> "Trajectory":
    if reference is None:
        raise SegslamError("--min-m: the data has no true poses; give lists with --pairs FILE")
    return reference


def _one_thread_each() -> None:
    """Limit Open3D and other libraries to one thread before they are loaded, because times are per core."""
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
